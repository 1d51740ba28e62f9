"""LPIPS: the same result as the package `lpips` with the same weights, and a clear message if a file is
missing.

The real weights are large and not ours to keep; the tests use weights in closed form instead.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from player.errors import ConfigError, FormatError, MissingExtraError, ShapeError
from vfr_bake.training.scores.lpips import Lpips

CONVOLUTIONS = {
    "alex": {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)},
    "vgg": {
        **{0: (64, 3, 3), 2: (64, 64, 3), 5: (128, 64, 3), 7: (128, 128, 3), 10: (256, 128, 3)},
        **{12: (256, 256, 3), 14: (256, 256, 3), 17: (512, 256, 3), 19: (512, 512, 3), 21: (512, 512, 3)},
        **{24: (512, 512, 3), 26: (512, 512, 3), 28: (512, 512, 3)},
    },
}
N_CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
CHECKPOINT = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}


def waves(*shape: int) -> torch.Tensor:
    """Return values in [-1, 1] without a pattern, the same on every machine."""
    return torch.from_numpy(np.sin(np.arange(np.prod(shape)) ** 1.5).astype(np.float32)).reshape(shape)


def write_backbone(home: Path, network: str) -> Path:
    state = {"classifier.6.bias": torch.zeros(1000)}  # the real files hold more than is read
    for index, (n_out, n_in, size) in CONVOLUTIONS[network].items():
        scale = (6 / (n_in * size * size)) ** 0.5  # keeps the signal's size from layer to layer
        state[f"features.{index}.weight"] = waves(n_out, n_in, size, size) * scale
        state[f"features.{index}.bias"] = 0.1 * waves(n_out)
    path = home / "hub" / "checkpoints" / CHECKPOINT[network]
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(state, path)
    return path


def write_package(folder: Path, network: str) -> Path:
    """Write the part of the package `lpips` that is read; importing it would fail."""
    path = folder / "lpips" / "weights" / "v0.1" / f"{network}.pth"
    path.parent.mkdir(parents=True)
    (folder / "lpips" / "__init__.py").write_text("raise ImportError('its weights are read, not its code')")
    layers = enumerate(N_CHANNELS[network])
    torch.save({f"lin{i}.model.1.weight": waves(1, n, 1, 1).abs() for i, n in layers}, path)
    return path


@pytest.fixture(params=["alex", "vgg"])
def network(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def package(tmp_path: Path, network: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path / "packages")
    return write_package(tmp_path / "packages", network)


def picture(height: int, width: int) -> np.ndarray:
    return (0.5 + 0.5 * waves(height, width, 3).numpy()).astype(np.float32)


@pytest.mark.usefixtures("package")
def test_it_is_what_the_package_computes(home: Path, network: str) -> None:
    """The distance is what lpips 0.1.4 with torchvision 0.28.0 returned for these weights and pictures."""
    write_backbone(home, network)
    distance = Lpips(network)
    a = picture(40, 48)
    expected = {"alex": (0.0249353, 1.7383846), "vgg": (0.0355390, 1.2802168)}[network]
    assert distance(a, a) == 0
    assert distance(a, 0.9 * a) == pytest.approx(expected[0], rel=1e-4)  # sums in float32, in any order
    assert distance(a, 1 - a) == pytest.approx(expected[1], rel=1e-4)
    assert distance(a, 1 - a) == pytest.approx(distance(1 - a, a), rel=1e-6)
    assert distance(a, 1 - a) > distance(a, 0.9 * a) > distance(a, 0.99 * a) > 0


@pytest.mark.usefixtures("package")
def test_pictures_too_small_or_of_two_sizes(home: Path, network: str) -> None:
    write_backbone(home, network)
    distance = Lpips(network)
    size = {"alex": 31, "vgg": 16}[network]
    assert distance(picture(size, size), 1 - picture(size, size)) > 0
    for a, b in (
        (picture(size - 1, 50), picture(size - 1, 50)),
        (picture(50, size - 1), picture(50, size - 1)),
        (picture(40, 40), picture(40, 41)),
        (picture(40, 40)[..., :2], picture(40, 40)[..., :2]),
    ):
        with pytest.raises(ShapeError, match=f"at least {size} x {size} pixels, got "):
            distance(a, b)


@pytest.mark.usefixtures("package")
def test_missing_weights_say_which_file_goes_where(home: Path, network: str) -> None:
    with pytest.raises(FormatError) as caught:
        Lpips(network)
    message = str(caught.value)
    assert message.startswith(str(home / "hub" / "checkpoints" / CHECKPOINT[network]))
    assert f"download https://download.pytorch.org/models/{CHECKPOINT[network]} and put it there" in message
    assert "TORCH_HOME" in message and "\n" not in message
    assert not home.exists(), "nothing is downloaded"


@pytest.mark.usefixtures("home")
def test_missing_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vfr_bake.training.scores.lpips.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'vfr-bake\[lpips\]'"):
        Lpips()


@pytest.mark.parametrize("network", ["alex"])
@pytest.mark.parametrize("content", ["cut short", "a list", "another network"])
def test_broken_weights_are_named(home: Path, package: Path, content: str) -> None:
    backbone = write_backbone(home, "alex")
    for path in (backbone, package):
        good = path.read_bytes()
        if content == "cut short":
            path.write_bytes(good[: len(good) // 2])
        elif content == "a list":
            torch.save([1, 2], path)
        else:
            state = torch.load(path, weights_only=True)
            torch.save({key: torch.zeros(*value.shape, 2) for key, value in state.items()}, path)
        with pytest.raises(FormatError) as caught:
            Lpips("alex")
        assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
        path.write_bytes(good)
    Lpips("alex")


def test_unknown_network() -> None:
    with pytest.raises(ConfigError, match="expected one of alex, vgg, got squeeze"):
        Lpips("squeeze")
