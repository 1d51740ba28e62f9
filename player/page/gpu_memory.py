"""The memory that an asset's page takes: that of the graphics card for the textures which `grid.js` and
`textures.js` make, and that of the device while `parts.js` decodes the scene."""

from __future__ import annotations

import math

from player.asset.asset import Asset
from player.errors import FormatError

DENSITY_BRICK = (8, 8, 10)
"""Texels of a brick of densities: 8 x 8 columns of ten. Each has the codes of four vertices, except the last
of a column, which tells which cells of the column are live."""
COLUMN_BRICK = (9, 8, 1)
"""Texels, of four numbers of 32 bits each, of a brick that gives the rows of features."""
FEW_LAYERS = 25
"""Most bricks on top of each other in a texture that is higher than wide."""
MOST_LAYERS = 256
MOST_BRICKS = FEW_LAYERS * 256**2
WIDTH = 2048
"""Most texels of a line of features."""
LINES_A_LAYER = 256
MOST_LAYERS_OF_FEATURES = 256
MOST_ROWS = 2**24
TILE = 256
"""Pixels along a side of a tile, the part of the picture that is drawn at a time."""
MOST_CHANNELS = 40
"""Most channels that a page can draw: eight per draw buffer, with one buffer for the opacity. WebGL2
guarantees four buffers, graphics cards have eight, and the renderer of Chromium for machines without a card
has six. Phones and tablets of Apple also limit the bits of a pixel in all buffers together, to 512, or 256
where they are older. A buffer of eight channels has 128 bits and that of the opacity 64, so that they draw at
most 24 or 8 channels; there `renderer.js` refuses a page with more."""

MOST_DECODING_BYTES = 3_200_000_000
"""Most bytes of memory that a page may take to decode a scene: MOST_BYTES in `parts.js`."""


def decoding_bytes(asset: Asset) -> int:
    """Return the most bytes of memory that a page takes to decode the asset: the sum of `neededBytes` in
    `parts.js` over all levels."""
    return sum(
        2000 * len(bricks) + (40 + 2 * grid.n_channels) * vertices.n
        for grid in (asset.arrays.densities, asset.arrays.features)
        for bricks, vertices in zip(grid.pyramid.levels, grid.pyramid.vertices, strict=True)
    )


def gpu_bytes(asset: Asset) -> int:
    """Return the bytes of graphics memory that the asset's textures and a tile of the picture take.

    Raises FormatError: one of its arrays is larger than any texture.
    """
    grid = asset.grid
    cubes = 4 * (grid.n_per_axis**3 + grid.rows.n_per_axis**3)
    density = 4 * block_texels(len(grid.slot_coords), DENSITY_BRICK)
    columns = 16 * block_texels(len(grid.rows.rows) // 729, COLUMN_BRICK)
    features = feature_bytes(len(grid.features), grid.n_channels)
    tile = TILE * TILE * (16 * -(-grid.n_channels // 8) + 8 + 4)
    return cubes + density + columns + features + tile


def block_texels(n: int, brick: tuple[int, int, int]) -> int:
    """Return the number of texels of a texture of `n` bricks.

    >>> block_texels(0, (8, 8, 10)), block_texels(25, (8, 8, 10)), block_texels(26, (8, 8, 10))
    (640, 16000, 17920)
    """
    across, layers = block_shape(n, brick)
    return across**2 * layers * math.prod(brick)


def block_shape(n: int, brick: tuple[int, int, int]) -> tuple[int, int]:
    """Return how many bricks a texture of `n` bricks has along its width and its height, and on top of each
    other: `blockOf` in `grid.js`, which says why.

    >>> block_shape(25, (8, 8, 10)), block_shape(26, (8, 8, 10)), block_shape(200_000, (9, 8, 1))
    ((1, 25), (2, 7), (29, 238))
    """
    if n > MOST_BRICKS:
        raise FormatError(f"graphics memory: expected at most {MOST_BRICKS} bricks, got {n}")
    width, _, height = brick
    across = max(math.ceil(math.sqrt(n / MOST_LAYERS)), 1)
    while (layers := max(-(-n // across**2), 1)) > FEW_LAYERS and across * width < layers * height:
        across += 1
    return across, layers


def feature_bytes(n: int, n_channels: int) -> int:
    """Return the bytes of a texture of `n` rows of features: four channels per texel, and as many rows in a
    line as fit, a power of two.

    >>> feature_bytes(0, 12), feature_bytes(512 * 256 + 1, 12) == 2 * 512 * 256 * 12
    (6144, True)
    """
    words = -(-n_channels // 4)
    per_line = 2 ** math.floor(math.log2(WIDTH / words))
    most = min(MOST_ROWS, per_line * LINES_A_LAYER * MOST_LAYERS_OF_FEATURES)
    if n > most:
        raise FormatError(f"graphics memory: expected at most {most} rows of features, got {n}")
    lines = max(-(-n // per_line), 1)
    layers = -(-lines // LINES_A_LAYER)
    return 4 * words * per_line * min(lines, LINES_A_LAYER) * layers
