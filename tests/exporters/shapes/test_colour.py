"""Tests of the sRGB curve, above all where its two pieces meet."""

from __future__ import annotations

import numpy as np

from exporters.shapes.colour import linear_from_srgb
from tests.reference import srgb_from_linear


def test_known_values() -> None:
    # 0.2158605 = ((128/255 + 0.055) / 1.055)^2.4, the textbook value of mid-grey.
    np.testing.assert_allclose(linear_from_srgb([0, 128 / 255, 1]), [0, 0.2158605, 1], atol=1e-7)


def test_both_pieces_meet_at_the_joint() -> None:
    # The published constants meet to within 3e-8, not exactly.
    joint = 0.04045
    below, above = linear_from_srgb([joint, np.nextafter(joint, 1)])
    assert abs(above - below) < 3e-8


def test_round_trip_of_every_byte() -> None:
    srgb = np.arange(256) / 255
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(srgb)), srgb, atol=1e-7)
    assert (
        np.rint(255 * srgb_from_linear(np.rint(65535 * linear_from_srgb(srgb)) / 65535)) == np.arange(256)
    ).all()
    assert (np.diff(linear_from_srgb(np.linspace(0, 1, 10001))) > 0).all()
