"""Tests of how layers of a frame look: their colours, and the values that are spread over them."""

from __future__ import annotations

import numpy as np

from player.render import Frame
from player.viewer.layers import coloured, layer_picture

VIRIDIS = ("440154", "3b528b", "21918c", "5ec962", "fde725")
"""matplotlib's colour map at 0, 1/4, 1/2, 3/4 and 1, as its documents list it."""


def test_the_colours_are_viridis() -> None:
    wanted = [[int(text[k : k + 2], 16) for k in (0, 2, 4)] for text in VIRIDIS]
    np.testing.assert_allclose(coloured(np.linspace(0, 1, 5)) * 255, wanted, rtol=0, atol=1e-9)
    np.testing.assert_allclose(coloured(np.array([0.125])) * 255, [np.mean(wanted[:2], axis=0)], atol=1e-9)


def test_depth_is_spread_between_the_hundredths_at_its_ends() -> None:
    """Depth is spread between its 1st and 99th percentile (here 2 and 198), yellow (near) to blue (far)."""
    depth = np.arange(201, dtype=np.float32)[None]
    opacity, zeros = np.ones_like(depth), np.zeros_like(depth)
    frame = Frame(np.zeros((1, 201, 3), np.float32), opacity, depth, zeros, (1.0, 1.0, 1.0))
    wanted = coloured(1 - np.clip((depth - 2) / 196, 0, 1)) * 255
    assert np.abs(layer_picture(frame, "depth") - wanted).max() <= 0.51
