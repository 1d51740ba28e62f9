"""Rays at their ends: they enter the box where exact fractions say, and every march ends within a bound that
is computed and counted."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from types import ModuleType

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from player.asset.manifest import Manifest
from player.cameras.camera import Camera
from player.compiled import march as march_compiled
from player.errors import FormatError
from player.march import march
from player.march.box import BoxPath, enter_box
from tests.numerics.bounds import Row
from tests.numerics.fog import fog
from tests.player.conftest import look_at

MARCHES = [pytest.param(march, id="numpy"), pytest.param(march_compiled, id="numba")]
THIN = fog(1e-6)
DIAGONAL = 2 * 3**0.5
HALF = 0.5**0.5

NAMED_RAYS = (
    "along an axis, -0.0, in and from a face, an edge, a corner, inside, behind, grazing, tangent, 1e5 away"
)
ENTRY = Row(
    "Rays",
    "entry into the box",
    NAMED_RAYS,
    8,
    "u of the largest coordinate",
    "as the exact fractions have it",
)
LENGTH = Row(
    "Rays",
    "length inside the box",
    NAMED_RAYS,
    16,
    "u of the largest coordinate",
    "0 for a ray that misses it",
)
PLACE = Row(
    "Rays", "place of the entry, in cells", NAMED_RAYS, 128, "u of the largest coordinate",
    "on a face or inside, never beside the box",
)  # fmt: skip
SAMPLES = Row(
    "Rays", "samples that both marches take, against the length in steps", "any ray, 1e-5 beside the faces",
    1.01, "samples", "places where the lattice ends within rounding of the exit may go either way",
)  # fmt: skip
MOST = Row(
    "Rays", "samples of a ray, share of the bound",
    "directions of 1e-45 to 1e38, NaN, infinite, origins to 1e7", 1,
    "of the lattice places on the diagonal, and 3", "the march ends there for any ray",
)  # fmt: skip
NO_NUMBERS = Row(
    "Rays", "rays that are no numbers", "NaN, infinite", unit="the other rays' pictures are the same",
    at_ends="they end, and spoil no other",
)  # fmt: skip
NO_THICKNESS = Row(
    "Rays",
    "box without thickness",
    unit="refused",
    at_ends="when the manifest is read; corners beyond 1e9, too",
)
DIRECTIONS = Row(
    "Rays", "length of a camera's rays", "focal lengths 1e-6 to 1e6, cameras to 1e9 away", 2, "u"
)


def most_samples(step: float) -> int:
    """Return the bound: the number of lattice places on the box's diagonal, and three for rounding."""
    return int(DIAGONAL / step) + 3


def exact_slabs(o: np.ndarray, d: np.ndarray) -> tuple[Fraction, Fraction] | None:
    """Return entry (at least 0) and exit of a ray in [-1, 1]^3, exact for its float32 numbers, or None."""
    low, high = Fraction(0), None
    for a, b in zip(o.tolist(), d.tolist(), strict=True):
        if b == 0:
            if not -1 <= a <= 1:
                return None
            continue
        first, second = sorted([(-1 - Fraction(a)) / Fraction(b), (1 - Fraction(a)) / Fraction(b)])
        low, high = max(low, first), second if high is None else min(high, second)
    return None if high is None or high < low else (low, high)


NAMED: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "along x": ((-3, 0.1, 0.2), (1, 0, 0)),
    "along -y with -0.0": ((0.1, 3, -0.2), (-0.0, -1, 0.0)),
    "along z with -0.0": ((0.1, 0.3, -3), (0.0, -0.0, 1)),
    "from a face": ((-1, 0.3, 0.1), (1, 0, 0)),
    "from a face, away": ((1, 0.3, 0.1), (1, 0, 0)),
    "in a face": ((-3, 1, 0.1), (1, 0, 0)),
    "just outside a face": ((-3, 1.00001, 0.1), (1, 0, 0)),
    "from an edge": ((-1, -1, 0.1), (HALF, HALF, 0)),
    "along an edge": ((-3, -1, -1), (1, 0, 0)),
    "from a corner, inwards": ((-1, -1, -1), (3**-0.5, 3**-0.5, 3**-0.5)),
    "through a corner, past": ((-3, -1, 1), (HALF, 0, HALF)),
    "from inside": ((0.2, -0.1, 0.3), (0.6, 0, -0.8)),
    "behind": ((3, 0, 0), (1, 0, 0)),
    "grazing": ((-3, 0.999999, 0), (1, 0, 0)),
    "tangent at an edge": ((-2, 0, 0), (HALF, HALF, 0)),
    "from far away": ((1e5, 0.3, 0.1), (-1, 0, 0)),
}


@pytest.mark.parametrize("name", NAMED)
@pytest.mark.parametrize("module", MARCHES)
def test_entry_and_exit_are_the_fractions(name: str, module: ModuleType) -> None:
    o, d = (np.float32([row]) for row in NAMED[name])
    entries = enter_box(THIN, o, d)
    wanted = exact_slabs(o[0], d[0])
    scale = max(1.0, float(np.abs(o).max()))
    rounding = 8 * 2**-24 * scale  # of the origin in cells, the difference to the face, the quotient
    length = 0.0 if wanted is None else float(wanted[1] - wanted[0])
    LENGTH.check(max(float(entries.length[0]), 0.0), length, of=rounding / 8)
    if length > 2 * rounding:
        assert wanted is not None
        ENTRY.check(float(entries.t[0]), float(wanted[0]), of=rounding / 8)
        place = o[0].astype(np.float64) + float(wanted[0]) * d[0].astype(np.float64)
        PLACE.check(entries.point[:, 0], (place + 1) * 8, of=rounding / 8)
    assert ((entries.point >= 0) & (entries.point <= 16)).all()
    taken = int(module.march(THIN, o, d, 5).n_density_samples[0])
    # where the lattice ends within rounding of the exit, there may be one sample more or fewer
    assert abs(taken - length / float(THIN.step)) <= 1 + 2 * rounding / float(THIN.step)
    MOST.check(taken, of=most_samples(float(THIN.step)))


coordinate = st.floats(-3, 3, width=32)
component = st.one_of(st.floats(-1, 1, width=32), st.sampled_from([0.0, -0.0, 1e-30, -1e-38, 1.0]))


@given(st.tuples(coordinate, coordinate, coordinate), st.tuples(component, component, component))
@example((3.0, -3.0, 0.0), (-1e-38, -1e-38, 1.0))  # from one face to another, beyond float32
def test_both_marches_meet_what_the_fractions_meet(o: tuple[float, ...], d: tuple[float, ...]) -> None:
    norm = math.sqrt(math.fsum(x * x for x in d))
    assume(norm >= 1e-3)
    rays_o, rays_d = np.float32([o]), np.float32([[x / norm for x in d]])
    wanted = exact_slabs(rays_o[0], rays_d[0])
    length = 0.0 if wanted is None else float(wanted[1] - wanted[0])
    for module in (march, march_compiled):
        result = module.march(THIN, rays_o, rays_d, 1)
        # a direction of 1e-30 along an axis meets faces within rounding of 1e-6 / 1e-30: all or nothing
        clear = all(abs(abs(x) - 1) > 1e-5 for x in o)
        if clear:
            SAMPLES.check(result.n_density_samples[0], length / float(THIN.step))
        assert np.isfinite(result.opacity).all() and np.isfinite(result.depth).all()
        MOST.check(result.n_density_samples, of=most_samples(float(THIN.step)))


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("size", [1e-45, 1e-30, 1e-20, 1e-6, 1e3, 1e20, 1e38])
def test_directions_that_are_not_unit_end_all_the_same(module: ModuleType, size: float) -> None:
    """Directions that are not unit vectors break the contract, but marches end, with finite numbers."""
    rays_o = np.float32([[0.1, 0.2, 0.3], [-3, 0.1, 0.2], [0.1, -1, 0.2]])
    rays_d = (np.float32([[1, 0, 0], [1, 0, 0], [0.6, 0.8, 0]]) * np.float64(size)).astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        result = module.march(THIN, rays_o, rays_d, 5)
    MOST.check(result.n_density_samples, of=most_samples(float(THIN.step)))
    assert np.isfinite(result.opacity).all()


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_rays_that_are_no_numbers_end_and_spoil_no_other(module: ModuleType, bad: float) -> None:
    good = np.float32([[-3, 0.1, 0.2]]), np.float32([[1, 0, 0]])
    rays_o = np.float32([[-3, 0.1, 0.2], [bad, 0, 0], [-3, 0, 0], [-3, 0.1, 0.2]])
    rays_d = np.float32([[1, 0, 0], [1, 0, 0], [1, bad, 0], [1, 0, 0]])
    with np.errstate(invalid="ignore", over="ignore"):
        result = module.march(THIN, rays_o, rays_d, 5)
    alone = module.march(THIN, *good, 5)
    for ray in (0, 3):
        NO_NUMBERS.holds(result.opacity[ray] == alone.opacity[0] and result.depth[ray] == alone.depth[0])
    MOST.check(result.n_density_samples, of=most_samples(float(THIN.step)))


@pytest.mark.parametrize("far", [1e3, 1e5, 1e6, 1e7])
@pytest.mark.parametrize("module", MARCHES)
def test_origins_far_away_take_no_more_samples_than_the_diagonal_has(module: ModuleType, far: float) -> None:
    """Origins far away take no more samples than the diagonal has. In float32 the length in the box is off by
    a sixteenth at 1e6 units and by all of it at 1e8. The renderer moves origins nearer (FAR_AWAY); here they
    stay as they are."""
    unit = 3**-0.5
    offsets = np.random.default_rng(0).uniform(-0.02, 0.02, (200, 3))
    rays_o = (np.full((200, 3), -far * unit) + offsets).astype(np.float32)
    rays_d = np.full((200, 3), unit, np.float32)
    result = module.march(THIN, rays_o, rays_d, 5)
    MOST.check(result.n_density_samples, of=most_samples(float(THIN.step)))
    assert np.isfinite(result.features).all()


def test_the_numpy_march_has_no_more_rounds_than_lattice_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each round moves every ray on by at least one place, so that rounds are at most the lattice places."""
    rounds = 0

    def counted(function: Callable[..., object]) -> Callable[..., object]:
        def counting(*arguments: object) -> object:
            nonlocal rounds
            rounds += 1
            return function(*arguments)

        return counting

    # in a round, the only ray either jumps or takes a chunk
    monkeypatch.setattr(BoxPath, "jump", counted(BoxPath.jump))
    monkeypatch.setattr(march, "_take", counted(march._take))
    rays = [np.float32([row]) for row in NAMED["from a corner, inwards"]]
    for size in (1.0, 1e-20, 1e-3):
        rounds = 0
        march.march(THIN, rays[0], (rays[1] * size).astype(np.float32), 5)
        assert rounds > 0
        MOST.check(rounds, of=most_samples(float(THIN.step)))


@pytest.mark.parametrize("module", MARCHES)
def test_an_empty_box_is_left_in_a_few_jumps(module: ModuleType) -> None:
    result = module.march(fog(1e-6, step=2 / 20000), np.float32([[-3, 5, 0]]), np.float32([[1, 0, 0]]), 5)
    assert result.n_density_samples.tolist() == [0] and not result.opacity.any()


@pytest.mark.parametrize("aabb", [((0, 0, 0), (0, 1, 1)), ((0, 0, 0), (1, -1, 1)), ((0, 0, 0), (1, 1, 2e9))])
def test_boxes_without_thickness_are_refused(aabb: tuple) -> None:
    with pytest.raises(FormatError, match="aabb: expected"):
        Manifest(generator="t", resolution=8, feature_resolution=8, step=0.1, density_range=(-5, 5),
                 n_channels=1, view_size=(4, 3), aabb=aabb)  # fmt: skip
    NO_THICKNESS.holds()


@pytest.mark.parametrize("focal", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("place", [4.0, 1e4, 1e9])
def test_rays_of_a_camera_are_unit(focal: float, place: float) -> None:
    """Rays of a camera are unit vectors, from the widest lens to the longest, as marches require."""
    camera = Camera("c", look_at((place, 2, 5), (1, 2, 3)), 9, 7, focal, focal, 4.5, 3.5)
    _, rays_d = camera.rays()
    lengths = np.linalg.norm(rays_d.astype(np.float64), axis=1)
    DIRECTIONS.check(lengths, 1.0, of=2.0**-24)
