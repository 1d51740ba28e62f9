"""Models of parts of one scene are joined again, and models that do not fit stay apart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from vfr_bake.data.models.joining import joined

N_PICTURES = 16


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("joining") / "database.db"


@pytest.fixture(scope="module")
def truth(database: Path) -> Any:
    """A model of sixteen pictures and three hundred points, each seen in six pictures."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 1, N_PICTURES
    options.num_points3D, options.track_length = 300, 6
    pycolmap.set_random_seed(1)
    with pycolmap.Database.open(database) as db:
        return pycolmap.synthesize_dataset(options, db)


def part(truth: Any, pictures: Sequence[int], scale: float = 1.0) -> Any:
    """Return a model of some of the pictures, in a frame of its own."""
    model = truth.__deepcopy__({})
    frames = sorted(truth.frames)
    for number in set(range(N_PICTURES)) - set(pictures):
        model.deregister_frame(frames[number])
    turn = np.array([0.1, 0.2, 0.3, 0.9])
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn / np.linalg.norm(turn)), [scale, 2, 3]))
    return model


def places(model: Any) -> dict[str, np.ndarray]:
    return {image.name: image.projection_center() for image in model.images.values() if image.has_pose}


def test_models_that_share_pictures_become_one(truth: Any, database: Path, tmp_path: Path) -> None:
    """Three models become one, although the third fits neither of the others until those are joined."""
    parts = [
        part(truth, range(4, 10), 2.5),
        part(truth, range(8)),
        part(truth, [6, 7, 9, *range(10, 16)], 0.3),
    ]
    whole, *rest = joined(parts, database, tmp_path)
    assert not rest and whole.num_reg_images() == N_PICTURES and whole.num_points3D() > 290
    assert whole.compute_mean_reprojection_error() < 0.01
    found, given = places(whole), places(truth)
    off = {a: np.array([np.linalg.norm(p[a] - p[b]) for b in given]) for p in (found,) for a in given}
    for name, distances in off.items():
        wanted = np.array([np.linalg.norm(given[name] - given[other]) for other in given])
        ratio = distances[wanted > 0] / wanted[wanted > 0]
        assert np.ptp(ratio) < 1e-4 * ratio.mean()


def test_models_that_share_too_little_stay_apart(truth: Any, database: Path, tmp_path: Path) -> None:
    parts = [part(truth, range(6, 9)), part(truth, range(7))]
    assert [model.num_reg_images() for model in joined(parts, database, tmp_path)] == [7, 3]
    assert joined([], database, tmp_path) == []


def test_a_model_that_contradicts_the_other_stays_apart(truth: Any, database: Path, tmp_path: Path) -> None:
    """A second model stays apart if it has the shared pictures in other places."""
    wrong = part(truth, range(4, 14))
    for frame in list(wrong.frames.values())[:12:2]:
        if frame.has_pose:
            frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), [0.3 * frame.frame_id, 5, 9])
    models = joined([part(truth, range(12)), wrong], database, tmp_path)
    assert [model.num_reg_images() for model in models] == [12, 10]
