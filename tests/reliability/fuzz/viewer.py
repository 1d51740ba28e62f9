"""Send broken messages to the viewer over real WebSockets: it has to go on serving, in bounded memory.

    python -m tests.reliability.fuzz.viewer --inputs 100000 --seed 0

Message i of a seed is always the same, except for the names of controls, which the server draws. N_CLIENTS
clients send messages side by side; after every batch a client that behaves asks for a picture. It is a
failure if errors appear on the terminal, or if a file is opened under a name from a message.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import random
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Origin

from tests.player.conftest import write_shells
from tests.player.viewer.viewer_client import CAMERA, SPOKEN, Server, decoded, still_serves
from tests.reliability.fuzz.broken import broken_bytes

N_CLIENTS = 6
BATCH = 3000
ROOM_MB = 700.0
"""MB by which the server may grow after the first batch; a picture of 3840 x 2160 takes half of it."""
MARK = "vfr-fuzz-name"
"""Part of every file name in the messages."""

WATCH = f"""
import sys
def heard(event, arguments):
    if event.startswith(("open", "os.", "shutil.", "subprocess.")) and {MARK!r} in repr(arguments):
        sys.stderr.write(f"touched {{event}} {{arguments!r}}\\n")
sys.addaudithook(heard)
"""

NUMBERS = (
    *(0, -1, 1, 0.5, math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324),
    *(1 << 31, (1 << 64) - 1, -(1 << 63)),
)
OTHERS = (
    *(None, True, False, "", "x", f"../../{MARK}", "9" * 300, "é\0", b"\0\xff"),
    *([], {}, [0] * 3, [1e9] * 200, {"value": {}}, [[[[]]]], {"": None}),
)
TYPES = (
    *("ShareUrlDisconnect", "FileTransferPart", "FileTransferStartUpload", "FileTransferPartAck"),
    *("GuiFormSubmitMessage", "GuiFormDirtyMessage", "GuiButtonHoldMessage", "CommandTriggerMessage"),
    *("ScenePointerMessage", "SceneNodeClickMessage", "SceneNodeDragMessage", "RunJavascriptMessage"),
    *("TransformControlsUpdateMessage", "GetRenderResponseMessage", "_CreateSceneNodeMessage", "Message", ""),
)
FIELDS = (
    *("uuid", "transfer_uuid", "source_component_uuid", "filename", "content", "part_count", "part_index"),
    *("size_bytes", "mime_type", "name", "owner", "updates", "phase", "payload"),
)
PROPERTIES = ("value", "update_cb", "removed", "sync_cb", "props", "gui_api", "is_button", "__class__", "max")


def odd(draw: random.Random) -> Any:
    """Return a value that a field may not expect."""
    return draw.choice(NUMBERS if draw.random() < 0.6 else OTHERS)


def message(draw: random.Random, controls: list[str]) -> bytes | str:
    """Return a message: a camera or a control with broken values or structure, or any other data."""
    kind = draw.random()
    if kind < 0.35:
        camera = json.loads(json.dumps(CAMERA))
        camera["position"][0] += draw.uniform(-1, 1)
        for _ in range(draw.choice((0, 0, 1, 1, 2))):
            key = draw.choice(list(camera))
            if isinstance(camera[key], list) and camera[key] and draw.random() < 0.6:
                camera[key][draw.randrange(len(camera[key]))] = odd(draw)
            else:
                camera[key] = odd(draw)
        sent: Any = _restructured(draw, camera)
    elif kind < 0.7:
        name = draw.choice(controls) if controls and draw.random() < 0.9 else draw.choice(("", "x" * 99, 7))
        value = odd(draw) if draw.random() < 0.7 else [draw.randrange(-9, 300) for _ in range(3)]
        updates = {"value" if draw.random() < 0.8 else draw.choice(PROPERTIES): value}
        sent = _restructured(draw, {"type": "GuiUpdateMessage", "uuid": name, "updates": updates})
    elif kind < 0.8:
        sent = {"type": draw.choice(TYPES)} | {draw.choice(FIELDS): odd(draw) for _ in range(4)}
    elif kind < 0.85:
        return draw.choice(("", "text", json.dumps(CAMERA)))
    elif kind < 0.86:
        return bytes([draw.choice((0x91, 0x81, 0xDD))]) * draw.randrange(4000)  # nested, or long
    else:
        data = msgspec.msgpack.encode(CAMERA) if kind < 0.95 else draw.randbytes(draw.randrange(400))
        return broken_bytes(data, np.random.default_rng(draw.getrandbits(32)))[:4000]
    return msgspec.msgpack.encode(sent)


def _restructured(draw: random.Random, sent: dict[str, Any]) -> Any:
    what = draw.random()
    if what < 0.05:
        del sent[draw.choice(list(sent))]
    elif what < 0.1:
        sent[draw.choice(("extra", "type", MARK))] = odd(draw)
    elif what < 0.12:
        return draw.choice(([sent], {"messages": [sent]}, list(sent.values()), repr(sent)))
    return sent


async def attack(server: Server, numbers: list[int], seed: int, counts: Counter[str]) -> None:
    """Send these messages of the seed, on a new connection whenever the server drops one."""
    left = list(numbers)
    while left:
        try:
            async with connect(
                f"ws://127.0.0.1:{server.port}", origin=Origin(f"http://127.0.0.1:{server.port}"),
                subprotocols=SPOKEN, max_size=None, compression=None, ping_interval=None, open_timeout=60,
            ) as client:  # fmt: skip
                counts["connections"] += 1
                await _talk(client, left, seed, counts)
        except ConnectionClosed:
            counts["dropped"] += 1
        except (InvalidHandshake, OSError):  # no room until the server notices who is gone
            await asyncio.sleep(0.2)


async def _talk(client: ClientConnection, left: list[int], seed: int, counts: Counter[str]) -> None:
    controls: list[str] = []
    ready = asyncio.Event()

    async def read() -> None:
        async for batch in client:
            for said in decoded(batch):
                if "uuid" in said and "props" in said:
                    controls.append(said["uuid"])
            if len(controls) > 10:
                ready.set()

    reader = asyncio.create_task(read())
    try:
        await client.send(msgspec.msgpack.encode(CAMERA))
        await asyncio.wait_for(ready.wait(), 60)
        for n_sent in range(1, len(left) + 1):
            number = left.pop()
            draw = random.Random(f"{seed} {number}")
            counts["messages"] += 1
            await client.send(message(draw, sorted(controls)))
            if draw.random() < 0.001:
                counts["too long"] += 1
                await client.send(b"x" * 5000)
            if n_sent % 250 == 0 or not left:
                await asyncio.wait_for(await client.ping(), 60)
    finally:
        reader.cancel()


def fuzz(n_inputs: int, seed: int) -> dict[str, Any]:
    """Send `n_inputs` messages in batches, and return what became of the server."""
    begin = time.monotonic()
    counts: Counter[str] = Counter()
    failures: list[str] = []
    resident: list[float] = []
    with tempfile.TemporaryDirectory(prefix="vfr-fuzz-") as folder:
        work = Path(folder)
        assets = [write_shells(work / "one"), write_shells(work / "other", sign=-1)]
        server = Server(work / "errors.txt", *assets, program=WATCH)
        try:
            for start in range(0, n_inputs, BATCH):
                numbers = list(range(start, min(start + BATCH, n_inputs)))
                asyncio.run(_attack_together(server, numbers, seed, counts))
                still_serves(server)
                resident.append(round(server.resident_mb(), 1))
        except Exception as error:
            failures.append(f"message {counts['messages']}: {error!r}: {traceback.format_exc()[-1500:]}")
        if server.process.poll() is not None:
            failures.append(f"the server ended with {server.process.returncode}")
        code = server.stop()
        said = server.errors.read_text()
    if code != 130:
        failures.append(f"Ctrl-C: exit code {code}")
    for sign in ("Traceback", "Error", "never retrieved", "touched", "Warning"):
        if sign in said:
            failures.append(said[max(said.index(sign) - 500, 0) :][:3000])
            break
    if resident and max(resident) > resident[0] + ROOM_MB:
        failures.append(f"memory: {resident}")
    return {
        "seed": seed,
        **counts,
        "failures": failures,
        "resident_mb": [min(resident), max(resident), resident[-1]] if resident else [],
        "seconds": round(time.monotonic() - begin, 1),
    }


async def _attack_together(server: Server, numbers: list[int], seed: int, counts: Counter[str]) -> None:
    parts = [numbers[index::N_CLIENTS] for index in range(N_CLIENTS)]
    await asyncio.gather(*(attack(server, part, seed, counts) for part in parts))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    result = fuzz(options.inputs, options.seed)
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
