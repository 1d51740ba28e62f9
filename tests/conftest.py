"""What all tests share: hypothesis' profile, the real data sets, and the record of a run's numeric errors."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

import vfr_bake  # noqa: F401  (before torch and numba: it tells OpenMP how to wait)
from tests.cores import keep_to_a_share
from tests.numerics import bounds

# This, too, has to run before torch and numba are imported: each asks only once how many cores there are.
keep_to_a_share()

# Hypothesis' deadline for an example is off, because it would measure the machine and not the code.
settings.register_profile("any_machine", deadline=None)
settings.load_profile("any_machine")

# A background job of a shell ignores Ctrl-C (SIGINT), and so would the programs that the tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--numerics", metavar="FILE", help="write the worst errors that the tests met to this file"
    )


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand over or write the worst numeric errors that the tests have met. A worker of pytest-xdist hands its
    own over to the process that started it; that process, or the only one, writes the file."""
    path, handed_over = session.config.getoption("--numerics"), getattr(session.config, "workeroutput", None)
    if handed_over is not None:
        handed_over["numerics"] = bounds.MET
    elif path:
        bounds.write(Path(path), bounds.MET)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Add the worst errors that a worker has met. A worker that was killed adds nothing."""
    bounds.MET.update(bounds.merged(bounds.MET, getattr(node, "workeroutput", {}).get("numerics", {})))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that takes a `device` on every device of this machine. Without a GPU, no test is skipped."""
    if "device" in metafunc.fixturenames:
        import torch

        names = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
        metafunc.parametrize("device", [torch.device(name) for name in names], ids=names)


def _real_data(name: str, holds: str) -> Path:
    """Return a data set's folder in `$VFR_DATA` (default `../shared/data`); without it, fail the test."""
    data = os.environ.get("VFR_DATA")
    root = Path(data) if data else REPOSITORY.parent / "shared" / "data"
    folder = root / name
    if not (folder / holds).is_file():
        pytest.fail(f"{folder}: expected the {name} data set: set VFR_DATA to the folder that holds it")
    return folder


@pytest.fixture(scope="session")
def lego_400() -> Path:
    """The data set lego of NeRF-synthetic at 400x400."""
    return _real_data("lego_400", "transforms_train.json")


@pytest.fixture(scope="session")
def can() -> Path:
    """The data set can: 71 phone pictures with a COLMAP model."""
    return _real_data("can", "sparse/0/images.bin")


@pytest.fixture(scope="session")
def fox() -> Path:
    """The data set fox: 50 phone pictures with a transforms.json, lens distortion and unbounded
    surroundings."""
    return _real_data("fox", "transforms.json")


@pytest.fixture(scope="session")
def small_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built-in scene as a small NeRF-synthetic folder: 12 views to train on and 2 to test, 32x32."""
    from dataclasses import replace

    from PIL import Image

    from player.cameras.transforms import write_cameras
    from vfr_bake.data.demo import demo_views

    root = tmp_path_factory.mktemp("data")
    for split, views in zip(("train", "test"), demo_views(size=32, n_train=12, n_test=2), strict=True):
        (root / split).mkdir()
        for index, image in enumerate(views.images):
            Image.fromarray(image).save(root / split / f"r_{index}.png")
        cameras = [replace(c, name=f"./{split}/r_{index}") for index, c in enumerate(views.cameras)]
        (root / f"transforms_{split}.json").write_bytes(write_cameras(cameras))
    return root
