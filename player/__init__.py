"""Player for baked Volume Feature Rendering assets on a CPU: it needs numpy, onnxruntime and Pillow, nothing
heavier.

>>> from player import Asset
>>> from player.render import render
>>> from player.cameras.views import asset_cameras
>>> asset = Asset.open("out/")
>>> frame = render(asset, asset_cameras(asset)[0])
>>> frame.rgb.shape
(40, 48, 3)

`play` writes pictures and videos, `serve` opens the viewer: the functions behind the command `vfr-play`.
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from player.app.options import PlaySettings
    from player.app.play import play
    from player.asset.asset import Asset
    from player.cameras.camera import Camera
    from player.render import Frame, Renderer
    from player.viewer.server import ServeSettings, serve

try:
    __version__ = version("vfr-bake")
except PackageNotFoundError:  # not installed: the folder also works when it is just copied
    __version__ = "0"

# onnxruntime from 1.31 on contacts its maker's server, also on Linux, unless this is set before its first
# session; its own function for switching that off comes too late.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__all__ = [
    "Asset", "Camera", "Frame", "PlaySettings", "Renderer", "ServeSettings", "__version__", "play", "serve",
]  # fmt: skip

_PLACES = {
    "Asset": "player.asset.asset",
    "Camera": "player.cameras.camera",
    "Frame": "player.render",
    "PlaySettings": "player.app.options",
    "Renderer": "player.render",
    "ServeSettings": "player.viewer.server",
    "play": "player.app.play",
    "serve": "player.viewer.server",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for, so that `import player` costs nothing."""
    if name not in _PLACES:
        raise AttributeError(f"module 'player' has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)
