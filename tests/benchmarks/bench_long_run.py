"""Ten thousand small frames, and clients of the viewer that come and go: memory must not grow.

    python tests/benchmarks/bench_long_run.py out/ --frames 10000
    python tests/benchmarks/bench_long_run.py out/ --clients 20 --rounds 3

Clients are WebSocket connections such as a browser opens. They read what the server sends and then
disconnect, half of them without closing the connection properly.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from player.asset.asset import Asset
from player.cameras.camera import orbit
from player.cameras.transforms import read_cameras
from player.render import Renderer
from player.viewer.server import free_port


def resident_mb(process: str = "self") -> float:
    """Return the MB of memory that a process holds now (Linux)."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def frames(folder: Path, n_frames: int) -> dict[str, object]:
    """Render frames, and note the memory after every twentieth part of them."""
    asset = Asset.open(folder)
    cameras = orbit(read_cameras(asset.path("cameras.json")), 100, (48, 40))
    held, begin = [], time.perf_counter()
    with Renderer(asset, 1) as renderer:
        for index in range(n_frames):
            renderer.render(cameras[index % 100], index % 7)
            if index % max(n_frames // 20, 1) == 0:
                held.append(round(resident_mb(), 1))
    settled = held[1:]
    return {"frames": n_frames, "seconds": round(time.perf_counter() - begin), "resident_mb": held,
            "grown_mb": round(max(settled) - settled[0], 1)}  # fmt: skip


def clients(folder: Path, n_clients: int, n_rounds: int) -> dict[str, object]:
    """Connect, read and disconnect; return the server's memory, and whether it is still running."""
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    port = free_port("127.0.0.1", None)
    origin = Origin(f"http://127.0.0.1:{port}")
    program = "import sys, player.app.cli as c; sys.exit(c.main())"
    command = [sys.executable, "-c", program, str(folder), "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    held, messages = [], 0
    try:
        for _ in range(n_rounds):
            some = []
            for _ in range(n_clients):
                some.append(
                    _patiently(
                        lambda: connect(
                            f"ws://127.0.0.1:{port}", subprotocols=spoken, origin=origin, max_size=None
                        )
                    )
                )
            for client in some:
                for _ in range(20):
                    try:
                        client.recv(timeout=0.5)
                    except TimeoutError:
                        break
                    messages += 1
            for index, client in enumerate(some):
                if index % 2:
                    client.close()
                else:
                    client.socket.close()
            time.sleep(1)
            held.append(round(resident_mb(str(process.pid)), 1))
        return {"clients": n_clients, "rounds": n_rounds, "messages": messages, "resident_mb": held,
                "still there": process.poll() is None}  # fmt: skip
    finally:
        process.terminate()
        process.wait()


def _patiently(what):
    """Try until the server has started, and has noticed which clients are gone without a word."""
    from websockets.exceptions import InvalidStatus

    until = time.monotonic() + 120
    while True:
        try:
            return what()
        except (OSError, InvalidStatus):
            if time.monotonic() > until:
                raise
            time.sleep(0.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--clients", type=int, help="look at the viewer instead")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    if options.clients:
        print(json.dumps(clients(options.asset, options.clients, options.rounds)))
    else:
        print(json.dumps(frames(options.asset, options.frames)))


if __name__ == "__main__":
    main()
