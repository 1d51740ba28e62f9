"""Tests of the manifest's numbers at their limits, and of matrices that are nearly a similarity."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset
from player.asset.manifest import Manifest, manifest_bytes, parse_manifest
from player.errors import FormatError
from tests.player.asset.test_asset import SMALLEST

LIMITS: dict[str, tuple[Any, Any, Any, Any]] = {
    "resolution": (0, 1, 2048, 2049),
    "feature_resolution": (0, 1, 2048, 2049),
    "n_fetches": (-1, 0, 1024, 1025),
    "n_channels": (0, 1, 1024, 1025),
    "density_range": ((-80.5, 1), (-80, 1), (0, 80), (0, 80.5)),
    "background": ((-0.01, 0, 0), (0, 0, 0), (1, 1, 1), (1, 1, 1.01)),
    "view_size": ((0, 1), (1, 1), (2**20, 2**20), (1, 2**20 + 1)),
    "aabb": (
        ((-1001,) * 3, (-1000, 0, 0)),
        ((-1000,) * 3, (-999, 0, 0)),
        ((0, 0, 999), (1e3, 1e3, 1000)),
        ((0, 0, 1000), (1e3, 1e3, 1001)),
    ),
    "step": (0.9e-9, 1e-4, 1e9, 1.1e9),
}
"""By key: a value below the limits, the least and the greatest accepted, and one above the limits, as in
`player.asset.manifest`. The accepted step is above its lower limit, which gives too many samples."""


@pytest.mark.parametrize("key", LIMITS)
def test_numbers_are_accepted_up_to_their_limits(key: str) -> None:
    below, least, most, above = LIMITS[key]
    for value in (least, most):
        other = {"resolution": 2048} if key == "feature_resolution" else {}
        other |= {"feature_resolution": 1} if key == "resolution" else {}
        assert getattr(replace(SMALLEST, **(other | {key: value})), key) == value
    for value in (below, above):
        with pytest.raises(FormatError, match=f"{key}: expected"):
            replace(SMALLEST, **{key: value})


@pytest.mark.parametrize("one", [("[", "]"), ('{"a":', "}")])
def test_lists_and_objects_may_be_nested_up_to_a_limit(one: tuple[str, str], asset: Asset) -> None:
    """The manifest and its `provenance` are two of them. The reader of JSON would take thousands, which those
    that show them have no stack for."""

    def parsed(n: int) -> Manifest:
        nested = one[0] * n + "1" + one[1] * n
        text = manifest_bytes(asset.manifest).decode().replace("30.5", nested)
        return parse_manifest(text.encode(), "m.json")

    assert parsed(62).provenance
    with pytest.raises(
        FormatError, match=r"m\.json: expected at most 64 lists and objects inside one another"
    ):
        parsed(63)


def rotation(random: np.random.Generator) -> np.ndarray:
    """Return a uniformly random rotation [3, 3], from a normally distributed quaternion."""
    w, x, y, z = (q := random.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def with_matrix(linear: np.ndarray, last: tuple[float, ...] = (0, 0, 0, 1)) -> Manifest:
    rows = [(*row, 5.0) for row in linear.tolist()]
    return replace(SMALLEST, world_from_model=(*map(tuple, rows), last))


def test_every_rotation_with_one_scale_is_a_world_and_no_reflection_is() -> None:
    random = np.random.default_rng(0)
    for _ in range(300):
        linear = rotation(random) * 10 ** random.uniform(-3, 3)
        assert with_matrix(linear).world_from_model[0][3] == 5
        axis = random.integers(3)
        mirrored = linear.copy()
        mirrored[:, axis] *= -1
        with pytest.raises(FormatError, match="world_from_model: expected a rotation"):
            with_matrix(mirrored)


@pytest.mark.parametrize("first", range(3))
@pytest.mark.parametrize("second", range(3))
def test_an_axis_of_another_length_or_aslant_is_refused(first: int, second: int) -> None:
    """An entry that is off by 2e-3 of the scale is refused; 2e-5 counts as rounding."""
    for size in (1e-6, 1.0, 1e6):
        linear = np.eye(3)
        linear[first, second] += 2e-3
        with pytest.raises(FormatError, match="world_from_model: expected a rotation"):
            with_matrix(linear * size)
        linear = np.eye(3)
        linear[first, second] += 2e-5
        with_matrix(linear * size)


@pytest.mark.parametrize("last", [(0, 0, 0, 2), (1e-3, 0, 0, 1), (0, 0, -1, 1)])
def test_the_last_row_is_that_of_an_affine_map(last: tuple[float, ...]) -> None:
    with pytest.raises(FormatError, match="world_from_model: expected a rotation"):
        with_matrix(np.eye(3), last)
