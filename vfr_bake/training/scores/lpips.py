"""LPIPS: the distance between two pictures in the features of a network that was trained for recognition.

Zhang, Isola, Efros, Shechtman and Wang, "The unreasonable effectiveness of deep features as a perceptual
metric", 2018, version 0.1: d = sum over layers l of mean over pixels of sum_c w_lc (f_lc - g_lc)^2, with f, g
the two pictures' activations, of unit length at every pixel, and w the layer's learned weights.

Only the weights w are read from the package `lpips`. Its code is not used, because it needs torchvision for
two lists of convolutions, and torchvision's build has to match torch's in version and GPU. The lists are
written down here instead. The weights of the convolutions are torchvision's, read from the folder where torch
keeps its downloads. Nothing is downloaded here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import nn

from player.errors import ConfigError, FormatError, MissingExtraError, ShapeError
from vfr_bake.training.tensor_files import read_tensors

MEAN = (-0.030, -0.088, -0.188)
DEVIATION = (0.458, 0.448, 0.450)
"""Mean and standard deviation by which the networks' inputs, in [-1, 1], were normalised."""


class Lpips:
    """Distance between pictures by one network, 0 for equal pictures. The weights are loaded once."""

    def __init__(self, network: str = "alex") -> None:
        """`network`: "alex" (AlexNet, which papers report most) or "vgg" (VGG-16).

        Raises MissingExtraError: the package `lpips` is not installed; FormatError: a file of weights is
        missing or broken; ConfigError: no such network.
        """
        if network not in _NETWORKS:
            raise ConfigError(f"lpips: network: expected one of {', '.join(_NETWORKS)}, got {network}")
        self.network = network
        self._settings = _NETWORKS[network]
        self._layers = self._settings.layers()
        self._weights = _layer_weights(network, self._n_channels())
        _load_layers(self._layers, self._settings.checkpoint)

    @torch.no_grad()
    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the distance between two pictures [height, width, 3] with values in [0, 1].

        Raises ShapeError: the pictures differ in shape, or are so small that the deepest layer has no pixel.
        """
        size = self._settings.min_size
        if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3 or min(a.shape[:2]) < size:
            raise ShapeError(
                f"lpips: expected [height, width, 3] twice, of at least {size} x {size} pixels, "
                f"got {list(a.shape)} and {list(b.shape)}"
            )
        layers = zip(self._weights, self._activations(a), self._activations(b), strict=True)
        return sum(float((w * (f - g) ** 2).sum(dim=1).mean()) for w, f, g in layers)

    def _activations(self, rgb: np.ndarray) -> list[torch.Tensor]:
        """Return a tensor [1, n_channels, h, w] for each compared layer, of unit length over the channels."""
        values = (2 * np.asarray(rgb, np.float32) - 1 - np.array(MEAN)) / np.array(DEVIATION)
        x = torch.from_numpy(values).float().permute(2, 0, 1)[None].contiguous()
        taken = []
        for index, layer in enumerate(self._layers):
            x = layer(x)
            if index in self._settings.taken:
                taken.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return taken

    def _n_channels(self) -> list[int]:
        """Return the channels of each compared layer, which are those of the convolution before it."""
        convolutions = [self._layers[index - 1] for index in self._settings.taken]
        return [layer.out_channels for layer in convolutions if isinstance(layer, nn.Conv2d)]


def _alexnet() -> nn.Sequential:
    """Make the convolutions of AlexNet, numbered as torchvision's `alexnet().features`."""
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


def _vgg16() -> nn.Sequential:
    """Make the convolutions of VGG-16, numbered as torchvision's `vgg16().features`."""
    layers: list[nn.Module] = []
    n_in = 3
    for n_convolutions, n_out in ((2, 64), (2, 128), (3, 256), (3, 512), (3, 512)):
        if layers:
            layers.append(nn.MaxPool2d(2, 2))
        for _ in range(n_convolutions):
            layers += [nn.Conv2d(n_in, n_out, 3, padding=1), nn.ReLU()]
            n_in = n_out
    return nn.Sequential(*layers)


@dataclass(frozen=True)
class _Network:
    layers: Callable[[], nn.Sequential]
    checkpoint: str
    """Name of the file with the weights, both in torchvision's address and in torch hub's folder."""
    taken: tuple[int, ...]
    """Numbers of the layers whose activations are compared."""
    min_size: int
    """Smallest width and height in pixels with which a picture has a pixel left at the deepest layer."""


_NETWORKS = {
    "alex": _Network(_alexnet, "alexnet-owt-7be5be79.pth", (1, 4, 7, 9, 11), 31),
    "vgg": _Network(_vgg16, "vgg16-397923af.pth", (3, 8, 15, 22, 29), 16),
}


def _load_layers(layers: nn.Sequential, checkpoint: str) -> None:
    path = Path(torch.hub.get_dir()) / "checkpoints" / checkpoint
    address = f"https://download.pytorch.org/models/{checkpoint}"
    state = _read(path, f"download {address} and put it there, or set TORCH_HOME to where torch/hub has it")
    prefix = "features."
    features = {key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)}
    try:
        layers.load_state_dict(features)
    except RuntimeError as error:
        raise FormatError(f"{path}: the tensors do not fit the network: download {address} again") from error
    layers.eval().requires_grad_(False)


def _layer_weights(network: str, n_channels: list[int]) -> list[torch.Tensor]:
    """Read a tensor [1, n_channels, 1, 1] for each layer from the package `lpips`, without importing it."""
    package = find_spec("lpips")
    if package is None or not package.submodule_search_locations:
        raise MissingExtraError(
            "lpips is not installed: --lpips needs: pip install 'vfr-bake[lpips]', or, without torchvision, "
            "pip install --no-deps lpips"
        )
    path = Path(package.submodule_search_locations[0]) / "weights" / "v0.1" / f"{network}.pth"
    state = _read(path, "install lpips again")
    weights = [state.get(f"lin{layer}.model.1.weight") for layer in range(len(n_channels))]
    shapes = [None if w is None else tuple(w.shape) for w in weights]
    if shapes != [(1, n, 1, 1) for n in n_channels]:
        raise FormatError(f"{path}: the tensors do not fit the network: install lpips again")
    return [w for w in weights if w is not None]


def _read(path: Path, hint: str) -> dict[str, torch.Tensor]:
    state = read_tensors(path, f"weights of a network: {hint}", from_elsewhere=True)
    if not isinstance(state, dict):
        raise FormatError(f"{path}: expected the weights of a network, got {type(state).__name__}: {hint}")
    return state
