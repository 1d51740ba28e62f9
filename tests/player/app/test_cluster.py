"""Tests of frames on a Dask cluster of two workers, one of which is killed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from weakref import WeakSet

import pytest

import player
from player.app import cli
from player.app import cluster as cluster_module
from player.app.cluster import render_on_cluster
from player.app.jobs import Done, Job
from player.app.options import PlaySettings
from player.asset.asset import Asset
from player.cameras.camera import orbit
from player.cameras.views import asset_cameras
from player.errors import IntegrityError
from player.render import choose_march
from tests.player.conftest import write_shells
from tests.player.in_parts import write_in_parts

REPOSITORY = Path(__file__).resolve().parents[3]
N_FRAMES = 24
SECONDS = 300.0
"""Longest wait for a busy machine, in seconds."""


def start(module: str, *arguments: str) -> subprocess.Popen[bytes]:
    # Without a nanny, which would restart a killed worker.
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.{module}", *arguments],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


class Cluster:
    """A scheduler on this machine and its workers."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "scheduler.json"
        self.scheduler = start(
            "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show",
            "--scheduler-file", str(self._file),
        )  # fmt: skip
        self.workers: list[subprocess.Popen[bytes]] = []
        end = time.monotonic() + SECONDS
        while not self._file.is_file():
            assert self.scheduler.poll() is None and time.monotonic() < end
            time.sleep(0.1)
        self.address: str = json.loads(self._file.read_text())["address"]

    def add_worker(self) -> None:
        self.workers.append(
            start("dask_worker", self.address, "--no-nanny", "--nthreads", "1", "--no-dashboard")
        )

    def close(self) -> None:
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.close()


def play(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "player", *arguments],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.extra
def test_every_frame_arrives_once_though_a_worker_dies(
    cluster: Cluster, shells_folder: Path, tmp_path: Path
) -> None:
    cluster.add_worker()
    cluster.add_worker()
    views = [str(shells_folder), "--orbit", str(N_FRAMES), "--size", "320x320", "--threads", "1"]
    out, here = tmp_path / "there", tmp_path / "here"
    process = play(*views, "--output", str(out), "--dask", cluster.address, "--json", "-")
    end = time.monotonic() + SECONDS
    while not (out.is_dir() and len(list(out.glob("*.png"))) >= 3):
        assert process.poll() is None and time.monotonic() < end, process.communicate()
        time.sleep(0.01)
    cluster.workers[0].kill()
    finished = len(list(out.glob("*.png")))
    printed, errors = process.communicate(timeout=SECONDS)
    assert process.returncode == 0, errors
    assert finished < N_FRAMES, "it died midway"
    assert json.loads(printed)["frames"] == N_FRAMES
    assert cli.main([*views, "--output", str(here)]) == 0
    assert len(list(here.iterdir())) == N_FRAMES == len(list(out.iterdir()))
    for path in here.iterdir():
        assert (out / path.name).read_bytes() == path.read_bytes()


@pytest.mark.extra
@pytest.mark.parametrize("quality", ["high", "fast"])
def test_a_cluster_makes_the_frames_of_a_quality_as_one_machine_does(
    quality: str, cluster: Cluster, shells_folder: Path, tmp_path: Path
) -> None:
    """A frame has the same bytes whether it is made in one run, alone, in a resumed run, or by a worker."""
    cluster.add_worker()
    film = [
        str(shells_folder), "--orbit", "4", "--size", "61x47", "--threads", "1", "--quality", quality,
        "--format", "webp",
    ]  # fmt: skip
    assert cli.main([*film, "--output", str(tmp_path / "film")]) == 0
    assert cli.main([*film, "--output", str(tmp_path / "one"), "--frames", "2:3"]) == 0
    process = play(*film, "--output", str(tmp_path / "there"), "--dask", cluster.address)
    _, errors = process.communicate(timeout=SECONDS)
    assert process.returncode == 0, errors
    frames = sorted((tmp_path / "film").iterdir())
    assert [path.name for path in sorted((tmp_path / "there").iterdir())] == [path.name for path in frames]
    for path in frames:
        assert (tmp_path / "there" / path.name).read_bytes() == path.read_bytes()
    assert (tmp_path / "one" / frames[2].name).read_bytes() == frames[2].read_bytes()
    frames[1].unlink()
    assert cli.main([*film, "--output", str(tmp_path / "film"), "--resume"]) == 0
    for path in frames:
        assert (tmp_path / "there" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.extra
def test_what_is_said_when_it_cannot_be(
    cluster: Cluster,
    shells_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    views = [str(shells_folder), "--orbit", "2", "--size", "8x8", "--output", str(tmp_path / "o")]
    process = play(*views, "--dask", "tcp://127.0.0.1:1")
    _, errors = process.communicate(timeout=SECONDS)
    assert process.returncode == 1
    assert errors.startswith("vfr-play: error: --dask: tcp://127.0.0.1:1: expected a scheduler to answer")
    # on the worker, the path leads to another asset
    cluster.add_worker()
    code = (
        "import sys; from player.asset.asset import Asset; Asset.digest = 'another'\n"
        "from player.app.cli import main; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *views, "--dask", cluster.address],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("vfr-play: error: ") and "on a worker: expected the asset of the client" in last


def test_without_the_extra(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    options = ["--orbit", "2", "--output", str(tmp_path / "o"), "--dask", "tcp://127.0.0.1:1"]
    assert cli.main([str(shells_folder), *options]) == 1
    assert "pip install 'vfr-bake[cluster]'" in capsys.readouterr().err


# --- without a cluster ---


class Task:
    """A task of a cluster that this process stands in for; it runs when its result is asked for."""

    def __init__(self, function: Callable[..., Done], *arguments: Any) -> None:
        self.result = partial(function, *arguments)


@pytest.fixture
def tasks(monkeypatch: pytest.MonkeyPatch) -> Iterator[WeakSet[Task]]:
    """Let this process stand in for a cluster; yield the tasks that the client still refers to."""
    kept: WeakSet[Task] = WeakSet()

    class Client(nullcontext):
        def submit(self, function: Callable[..., Done], *arguments: Any, pure: bool) -> Task:
            task = Task(function, *arguments)
            kept.add(task)
            return task

    def wait(pending: list[Task], timeout: float, return_when: str) -> SimpleNamespace:
        return SimpleNamespace(done={next(iter(pending))})

    package = SimpleNamespace(Client=lambda address, timeout: Client(), wait=wait)
    monkeypatch.setitem(sys.modules, "distributed", package)
    yield kept
    cluster_module._renderer.cache_clear()


def rendered(asset: Asset, n_frames: int) -> Iterator[Done]:
    """Render small frames of an asset on a cluster."""
    cameras = orbit(asset_cameras(asset), n_frames, (16, 12))
    jobs = [Job(n, camera, None, None, "exact", "key", ".png") for n, camera in enumerate(cameras)]
    return render_on_cluster(
        "tcp://127.0.0.1:1", asset, jobs, PlaySettings(Path("o"), threads=1, march="numpy")
    )


def test_workers_march_as_the_key_of_a_frame_says(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client chooses the march, so that every worker uses the one that the key of a frame names."""
    marches: list[str] = []

    def on_cluster(address: str, asset: Asset, jobs: list[Job], settings: PlaySettings) -> Iterator[Done]:
        marches.append(settings.march)
        return iter(())

    monkeypatch.setattr(cluster_module, "render_on_cluster", on_cluster)
    player.play(asset, asset_cameras(asset), PlaySettings(tmp_path / "o", dask="tcp://127.0.0.1:1"))
    assert marches == [choose_march("auto")[0]]


def test_workers_need_not_keep_frames_that_have_arrived(asset: Asset, tasks: WeakSet[Task]) -> None:
    """A worker keeps a frame for as long as the client refers to its task."""
    assert [len(tasks) for _ in rendered(asset, 3)] == [3, 2, 1]


def test_the_threads_of_a_worker_open_an_asset_once(
    asset: Asset, tasks: WeakSet[Task], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []
    another = threading.Event()

    def opening(folder: Path, **how: Any) -> Asset:
        opened.append(folder)
        if len(opened) > 1:
            another.set()
        another.wait(1)  # time for the other thread
        return asset

    monkeypatch.setattr(cluster_module.Asset, "open", opening)
    where = str(asset.folder), asset.digest, asset.n_parts
    job = Job(0, orbit(asset_cameras(asset), 1, (16, 12))[0], None, None, "exact", "key", ".png")
    with ThreadPoolExecutor(2) as pool:
        done = [pool.submit(cluster_module._task, job, *where, 1, "numpy", None) for _ in range(2)]
        assert len({each.result().data for each in done}) == 1
    assert len(opened) == 1


def test_a_worker_with_an_incomplete_copy_is_refused(tasks: WeakSet[Task], tmp_path: Path) -> None:
    """A worker with fewer parts is refused; once its copy is whole, the same worker renders."""
    asset = Asset.open(write_in_parts(tmp_path / "asset"))
    last = asset.folder / f"part_{asset.n_parts - 1}.bin"
    content = last.read_bytes()
    last.unlink()
    message = f"on a worker: parts: expected {asset.n_parts} as on the client, got {asset.n_parts - 1}: "
    with pytest.raises(IntegrityError, match=message):
        list(rendered(asset, 1))
    last.write_bytes(content)
    assert [frame.index for frame in rendered(asset, 1)] == [0]


def test_a_worker_renders_the_asset_that_the_client_has_opened(
    tasks: WeakSet[Task], broken_folder: Path
) -> None:
    """If another asset takes its place on the disk, a worker goes on with the one that it has opened, and
    opens no other."""
    asset = Asset.open(broken_folder)
    before = [frame.data for frame in rendered(asset, 2)]
    frames = rendered(asset, 2)
    first = next(frames)
    shutil.rmtree(broken_folder)
    write_shells(broken_folder, sign=-1)
    assert sorted([first.data, *(frame.data for frame in frames)]) == sorted(before)
    cluster_module._renderer.cache_clear()
    with pytest.raises(IntegrityError, match="on a worker: expected the asset of the client, got another"):
        list(rendered(asset, 1))
