"""Tests that writes of compiled code beside the arrays that it is given are noticed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from player import scratch
from player.asset.asset import Asset
from player.compiled import march
from player.compiling import compiled
from player.scratch import check_scratch
from tests.player.march.contracted_scene import contracted_grid
from tests.player.march.pyramid_scene import random_scene
from tests.player.march.test_contracted_march import bumps, some_rays
from tests.player.march.test_march import random_rays


@compiled
def write_at(array, index):
    array[index] = 0


def test_the_tests_look() -> None:
    assert scratch.CANARIES


@pytest.mark.parametrize("shape", [7, (3, 5), (2, 0), (2, 3, 16)])
@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.int64])
def test_an_array_is_as_asked_for_and_whole(shape: Any, dtype: type) -> None:
    for fill in (None, 0, 3):
        array = scratch.scratch(shape, dtype, fill)
        assert array.shape == np.empty(shape).shape and array.dtype == dtype
        assert array.flags.c_contiguous and array.flags.writeable and array.ctypes.data % 16 == 0
        assert fill is None or (array == fill).all()
        array[...] = 1
        check_scratch(array)


@pytest.mark.parametrize(
    ("index", "side"), [(-13, "4 bytes before"), (12, "1 bytes behind"), (15, "13 bytes behind")]
)
def test_what_is_written_beside_an_array_is_seen(index: int, side: str) -> None:
    whole, array = scratch.scratch(12, np.int32, 0), scratch.scratch((3, 4), np.int32, 0)
    write_at(array.reshape(-1), index)  # -1 counts from the end, so that -13 is one before the first
    with pytest.raises(AssertionError, match=rf"\(3, 4\) int32.*{side}"):
        check_scratch((whole, array), whole)
    check_scratch(whole)


def is_guarded(array: np.ndarray) -> bool:
    base = array.base
    return (
        isinstance(base, np.ndarray)
        and base.dtype == np.uint8
        and base.size == array.nbytes + 2 * scratch.ROOM
    )


def arrays_in(argument: Any) -> Iterator[np.ndarray]:
    if isinstance(argument, tuple):
        for part in argument:
            yield from arrays_in(part)
    elif isinstance(argument, np.ndarray):
        yield argument


@pytest.mark.parametrize("kind", ["box", "space", "levels"])
def test_a_march_looks_beside_every_array_that_it_writes(
    kind: str, asset: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    module: Any = march
    grid = {
        "box": lambda: asset.grid,
        "space": lambda: contracted_grid(bumps, lambda x: np.linalg.norm(x, axis=-1) < 4),
        "levels": lambda: random_scene(44, 30, (1, 2, 4), seed=0, contracted=True).grid,
    }[kind]()
    rays = random_rays(40) if kind == "box" else some_rays(40)
    inner, handed = module._march_rays, []

    def watched(*arguments: Any) -> int:
        handed.append(arguments)
        return inner(*arguments)

    monkeypatch.setattr(module, "_march_rays", watched)
    before = [array.tobytes() for array in arrays_in((grid.table, grid.live, grid.density))]
    module.march(grid, *rays, 3)
    assert before == [array.tobytes() for array in arrays_in((grid.table, grid.live, grid.density))]
    arrays = list(arrays_in(handed[0]))
    of_grid = {id(array) for array in vars(grid).values()} | {id(array) for array in vars(grid.rows).values()}
    given = [array for array in arrays if id(array) not in of_grid and not is_guarded(array)]
    guarded = [array for array in arrays if is_guarded(array)]
    # Arrays that are not guarded are only read: the rays, their bounds, a lattice.
    kept = [array.tobytes() for array in given]
    inner(*handed[0])
    assert kept == [array.tobytes() for array in given]
    assert len(guarded) >= 14
    for which in range(len(guarded)):

        def careless(*arguments: Any, which: int = which) -> int:
            n = inner(*arguments)
            array = [array for array in arrays_in(arguments) if is_guarded(array)][which]
            write_at(array.base, scratch.ROOM + array.nbytes)
            return n

        monkeypatch.setattr(module, "_march_rays", careless)
        with pytest.raises(AssertionError, match="1 bytes behind"):
            module.march(grid, *rays, 3)


def test_without_canaries_there_is_the_array_alone() -> None:
    program = (
        "from player.scratch import scratch, check_scratch; "
        "a = scratch((2, 3), 'i4', 5); check_scratch(a); "
        "print(a.base is None, a.tolist(), scratch(2, 'f4', 0).tolist())"
    )
    environment = {key: value for key, value in os.environ.items() if key != "VFR_CANARIES"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "True [[5, 5, 5], [5, 5, 5]] [0.0, 0.0]"
