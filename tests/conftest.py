"""What all tests share: where the real pictures are, and what the numbers of a run were."""

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

# Before torch and numba as well, which ask once how many cores there are.
keep_to_a_share()

# A deadline measures the machine, not the code.
settings.register_profile("any_machine", deadline=None)
settings.load_profile("any_machine")

# A job in the background of a shell ignores Ctrl-C, and so would the programs that the tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--numerics", metavar="FILE", help="write the worst errors that the tests met to this file"
    )


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A worker of pytest-xdist hands over what its tests have met; who started it, or runs alone, writes."""
    path, handed_over = session.config.getoption("--numerics"), getattr(session.config, "workeroutput", None)
    if handed_over is not None:
        handed_over["numerics"] = bounds.MET
    elif path:
        bounds.write(Path(path), bounds.MET)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """What a worker has met; nothing of one that was killed."""
    bounds.MET.update(bounds.merged(bounds.MET, getattr(node, "workeroutput", {}).get("numerics", {})))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test that takes a `device` runs on every device that is there: none is skipped for want of a GPU."""
    if "device" in metafunc.fixturenames:
        import torch

        names = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
        metafunc.parametrize("device", [torch.device(name) for name in names], ids=names)


def _real_data(name: str, holds: str) -> Path:
    """A data set in `$VFR_DATA` (default `../shared/data`); missing, the test fails."""
    data = os.environ.get("VFR_DATA")
    root = Path(data) if data else REPOSITORY.parent / "shared" / "data"
    folder = root / name
    if not (folder / holds).is_file():
        pytest.fail(f"{folder}: expected the {name} data set: set VFR_DATA to the folder that holds it")
    return folder


@pytest.fixture(scope="session")
def lego_400() -> Path:
    """The NeRF-synthetic lego at 400x400."""
    return _real_data("lego_400", "transforms_train.json")


@pytest.fixture(scope="session")
def can() -> Path:
    """71 phone pictures with a COLMAP model."""
    return _real_data("can", "sparse/0/images.bin")


@pytest.fixture(scope="session")
def fox() -> Path:
    """50 phone pictures with a transforms.json, lens distortion and surroundings without end."""
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
