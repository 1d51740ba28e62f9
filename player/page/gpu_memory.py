"""How much graphics memory the page of an asset takes: the textures that `grid.js` and `textures.js` make.

Letters: nb, nf bricks along an axis of the densities' and of the features' grid. A long array is a layered
texture, 2048 texels wide, of at most 256 layers: `texture_bytes`.
"""

from __future__ import annotations

import math

from player.asset.asset import Asset
from player.errors import FormatError

WIDTH = 2048
"""Texels of a row of a layered texture."""
MOST_HEIGHT = 2048
LEAST_HEIGHT = 64
MOST_LAYERS = 256
TILE = 256
"""Pixels along a side of what is drawn at a time."""
HALF_COLUMNS = 162
"""Texels of a brick of densities: two for each of 9 x 9 columns."""
COLUMNS = 81
"""Texels of a brick that finds rows of features."""


def gpu_bytes(asset: Asset) -> int:
    """Bytes of graphics memory that the asset's textures take, and what a tile of the picture takes.

    Raises FormatError: one of its arrays is larger than any texture.
    """
    grid = asset.grid
    words = feature_words(grid.n_channels)
    wide = min(words, 4)
    cubes = 4 * (grid.n_per_axis**3 + grid.rows.n_per_axis**3)
    density = texture_bytes(HALF_COLUMNS * len(grid.slot_coords), 2)
    columns = texture_bytes(COLUMNS * (len(grid.rows.rows) // 729), 2)
    features = texture_bytes(-(-len(grid.features) * words // wide), wide)
    tile = TILE * TILE * (16 * -(-grid.n_channels // 8) + 8 + 4)
    return cubes + density + columns + features + tile


def texture_bytes(n: int, words: int) -> int:
    """Bytes of a layered texture that holds `n` texels of so many words of 32 bits.

    >>> texture_bytes(2048 * 64 + 1, 2) == 2 * 2048 * 64 * 8
    True
    """
    rows = max(-(-n // WIDTH), 1)
    height = min(1 << math.ceil(math.log2(rows)), LEAST_HEIGHT)
    while rows > MOST_LAYERS * height:
        height *= 2
    if height > MOST_HEIGHT:
        most = MOST_LAYERS * MOST_HEIGHT * WIDTH
        raise FormatError(f"graphics memory: expected at most {most} texels of a kind, got {n}")
    return -(-rows // height) * height * WIDTH * 4 * words


def feature_words(n_channels: int) -> int:
    """Words of 32 bits that a row of features takes: 1, 2 or an even number.

    >>> [feature_words(n) for n in (1, 8, 12, 16, 20)]
    [1, 2, 4, 4, 6]
    """
    words = -(-n_channels // 4)
    return words if words < 3 else words + words % 2
