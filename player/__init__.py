"""Plays a baked Volume Feature Rendering asset on a CPU: numpy, onnxruntime and Pillow, nothing heavier.

>>> import player
>>> player.Camera.__name__
'Camera'
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from player.asset import Asset
    from player.cameras import Camera
    from player.render import Renderer

try:
    __version__ = version("vfr-bake")
except PackageNotFoundError:  # the folder alone, copied somewhere: it works there too
    __version__ = "0"

__all__ = ["Asset", "Camera", "Renderer", "__version__"]

_PLACES = {
    "Asset": "player.asset",
    "Camera": "player.cameras",
    "Renderer": "player.render",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for, so that `import player` costs nothing."""
    if name not in _PLACES:
        raise AttributeError(f"module 'player' has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)
