"""Tests of colours of vertices that no picture shows: they spread from known ones, ring after ring."""

from __future__ import annotations

import numpy as np

from exporters.surface.asset_surface import _from_around


def strip(n: int) -> np.ndarray:
    """Return the faces of a strip of n vertices, each of three consecutive vertices."""
    return np.array([[i, i + 1, i + 2] for i in range(n - 2)])


def test_a_colour_goes_on_from_corner_to_corner() -> None:
    """One known colour spreads over the whole strip, and every vertex keeps its own alpha."""
    colours = np.zeros((9, 4))
    colours[:, 3] = np.arange(9)
    colours[0, :3] = 10, 20, 30
    known = np.arange(9) == 0
    found = _from_around(colours, known, strip(9))
    assert (found[:, :3] == [10, 20, 30]).all() and found[:, 3].tolist() == list(range(9))
    assert not colours[1:, :3].any() and known.sum() == 1, "what was given stays as it was"


def test_an_unknown_corner_has_the_mean_of_its_faces() -> None:
    """An unknown vertex gets the mean of its faces' colours, each the mean of the face's known vertices."""
    faces = np.array([[0, 1, 4], [2, 3, 4], [0, 0, 0]])
    colours = np.zeros((6, 4))
    colours[:4, 0] = 10, 30, 100, 7
    found = _from_around(colours, np.array([True, True, True, False, False, False]), faces)
    assert found[4, 0] == 60 and found[3, 0] == 100, "(20 + 100) / 2, and 100 alone"
    assert not found[5].any(), "a corner of no face keeps what it has"
    assert np.array_equal(_from_around(colours, np.ones(6, bool), faces), colours)
