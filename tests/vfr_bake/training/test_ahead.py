"""The next step's samples are drawn while a step is learned from, in the field as it was before that step."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numba
import pytest
import torch

from vfr_bake.config import FieldOptions, SceneKind, TrainConfig
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.scene import build_scene
from vfr_bake.training import ahead
from vfr_bake.training.ahead import SecondThread
from vfr_bake.training.guides import GROWTH, Growth
from vfr_bake.training.trainer import Trainer

FIELD = FieldOptions(n_levels=6, max_resolution=64, log2_table_size=12, head_width=24, density_width=16)
KINDS: tuple[SceneKind, ...] = ("object", "unbounded")


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Provide two threads to split, however many cores there are."""
    numba.get_num_threads()  # starts numba's threads, and OpenMP then gives torch as many
    n_torch = torch.get_num_threads()
    monkeypatch.setattr(ahead, "get_num_threads", lambda: 2)
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(n_torch)


def trainer(kind: SceneKind, pilot_steps: int) -> Trainer:
    """Return a trainer of the built-in scene, as an object or as an unbounded scene."""
    config = TrainConfig(
        device="cpu", steps=30, minutes=60.0, pilot_steps=pilot_steps, batch_samples=2048, batch_rays=64,
        occupancy_resolution=32, field=FIELD,
    )  # fmt: skip
    scene = build_scene(demo_capture(size=32, n_train=12, n_test=2), kind)
    return Trainer(replace(scene, has_alpha=True, masked=False), config)


def test_batches_of_an_unbounded_scene_grow_with_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch has 64 rays, half of that in the pilot's steps, and 16 more every second step from step 8."""
    monkeypatch.setitem(GROWTH, True, Growth(after=8, most=3.0))
    drawn = [report.n_rays for report in trainer("unbounded", 4).run()]
    assert drawn[:4] == [32] * 4 and drawn[4:10] == [64] * 6, "all rays of a scene without end are served"
    assert drawn[10:18] == [80, 80, 96, 96, 112, 112, 128, 128] and drawn[24:] == [192] * 6


def test_batches_of_an_object_grow_with_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch has at most 2,048 samples, half of that in the pilot's steps, and grows from step 8 on."""
    monkeypatch.setitem(GROWTH, False, Growth(after=8, most=2.0))
    reports = list(trainer("object", 4).run())
    most = [1024] * 4 + [2048] * 6 + [2560] * 2 + [3072] * 2 + [3584] * 2 + [4096] * 14
    assert all(report.n_samples <= budget for report, budget in zip(reports, most, strict=True))
    assert max(report.n_samples for report in reports[16:]) > 2048


def test_the_threads_are_shared_out_and_given_back(two_threads: None) -> None:
    second = SecondThread()
    assert second.is_there
    here, goes_on, n_numba = threading.get_ident(), threading.Event(), numba.get_num_threads()

    def work() -> tuple[bool, int]:
        goes_on.wait(10)
        return threading.get_ident() != here, numba.get_num_threads()

    with second.meanwhile(work) as result:
        assert torch.get_num_threads() == 1 and not result.done()
        goes_on.set()
        second.wait()
        assert result.done()
    assert result.result() == (True, 1)
    assert torch.get_num_threads() == 2 and numba.get_num_threads() == n_numba


def test_no_error_leaves_work_behind(two_threads: None) -> None:
    second, done = SecondThread(), threading.Event()
    with pytest.raises(KeyError), second.meanwhile(lambda: done.wait(0.2) or done.set()):
        raise KeyError
    assert done.is_set() and torch.get_num_threads() == 2
    with second.meanwhile(lambda: 1 // 0) as result:
        pass
    with pytest.raises(ZeroDivisionError):
        result.result()


def test_one_thread_has_no_second(two_threads: None) -> None:
    torch.set_num_threads(1)
    assert not SecondThread().is_there


@pytest.mark.parametrize("threaded", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_samples_are_those_of_the_field_a_step_before(kind: str, threaded: bool, two_threads: None) -> None:
    subject = trainer(kind, pilot_steps=3)
    subject._second.is_there = threaded
    grid, n_ahead = subject.field.grid, 0
    table = grid.table.detach().clone()
    for _ in subject.run():
        if subject._next is not None:
            samples, now = subject._next.samples, grid.table.detach().clone()
            assert len(samples.points) > 100
            with torch.no_grad():
                assert (grid(samples.points) - samples.features).abs().max() > 1e-5
                grid.table.copy_(table)
                # Equal up to rounding: the kernel that marches and the one that looks up may fuse products
                # and sums differently.
                torch.testing.assert_close(grid(samples.points), samples.features, rtol=0, atol=1e-6)
                grid.table.copy_(now)
            n_ahead += 1
        table = grid.table.detach().clone()
    assert n_ahead == 27, "all but the pilot's"


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_thread_changes_nothing_but_the_time(kind: str, two_threads: None) -> None:
    curves = []
    for threaded in (True, False):
        subject = trainer(kind, pilot_steps=5)
        subject._second.is_there = threaded
        curves.append(torch.tensor([report.loss for report in subject.run()]))
    # torch sums in another order on another number of threads.
    torch.testing.assert_close(curves[0][:10], curves[1][:10], rtol=1e-4, atol=0)
    torch.testing.assert_close(curves[0], curves[1], rtol=0.05, atol=0)
