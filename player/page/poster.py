"""The poster: the picture that a page shows before anything else, and where nothing else can be shown."""

from __future__ import annotations

import io

from player.asset.asset import Asset
from player.cameras.views import asset_cameras
from player.page.rest import rest_camera
from player.render import March, Renderer

LONGEST = 800
"""Most pixels of the longer side."""
QUALITY = 85


def poster_bytes(asset: Asset, n_threads: int | None = None, march: March = "auto") -> bytes:
    """Render a JPEG of the view that the page begins with, over the asset's background. `n_threads` and
    `march` are those of `player.render.render`.

    >>> poster_bytes(Asset.open("out/"))[:3]
    b'\\xff\\xd8\\xff'
    """
    from PIL import Image

    camera = rest_camera(asset_cameras(asset)).at_most(LONGEST)
    with Renderer(asset, n_threads, march) as renderer:
        frame = renderer.render(camera)
    buffer = io.BytesIO()
    Image.fromarray(frame.to_uint8()).save(buffer, "JPEG", quality=QUALITY, optimize=True, progressive=True)
    return buffer.getvalue()
