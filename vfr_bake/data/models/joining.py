"""Join several models of one scene into one.

The mapper begins another model with pictures that the first one could not take, and takes up to twenty that
the first one has as well. Points that such pictures see in both models tell how the second one lies in the
first (a similarity). The other pictures of the second one are then placed, all points are triangulated again
from the matches, and everything is adjusted together.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vfr_bake.data.mapping import adjust, pycolmap_module

MIN_COMMON = 3
"""Number of pictures that two models must share: fewer do not tell how one lies in the other."""
MIN_SEEN = 30
"""Number of points that each picture must see in the joined model: as many as the mapper itself asks for."""
MAX_ERROR = 2.0
"""Largest mean reprojection error of the joined model, in pixels. A model of the mapper has less than one."""


def joined(models: Sequence[Any], database: Path, pictures: Path) -> list[Any]:
    """Return the `pycolmap.Reconstruction`s, the largest first, once all that fit the largest have been
    joined into it.

    `database`: what they were built from; each of its pictures has a frame of its own.
    """
    left = sorted(models, key=lambda model: -model.num_reg_images())
    tried = 0
    while tried < len(left) - 1:
        both = _both(left[0], left[1 + tried], database, pictures)
        if both is None:
            tried += 1
        else:
            left = [both, *left[1 : 1 + tried], *left[2 + tried :]]
            tried = 0  # models that did not fit before may fit the joined one
    return left


def _both(first: Any, second: Any, database: Path, pictures: Path) -> Any | None:
    """Return the two models as one; None if they do not fit."""
    pycolmap = pycolmap_module()
    names = {image.name for image in first.images.values() if image.has_pose}
    others = {image.name: image for image in second.images.values() if image.has_pose}
    if len(names & others.keys()) < MIN_COMMON or others.keys() <= names:
        return None
    first_from_second = pycolmap.align_reconstructions_via_reprojections(second, first)
    if first_from_second is None:
        return None
    second = second.__deepcopy__({})
    second.transform(first_from_second)
    both = pycolmap.Reconstruction()
    for model in (first, second):
        for image in sorted(model.images.values(), key=lambda image: image.image_id):
            if image.has_pose and not both.exists_image(image.image_id):
                _add(both, model, image)
    with tempfile.TemporaryDirectory(prefix="vfr-join-", ignore_cleanup_errors=True) as work:
        both = pycolmap.triangulate_points(both, database, pictures, work, refine_intrinsics=False)
    adjust(both)
    placed = [image for image in both.images.values() if image.has_pose]
    fits = both.compute_mean_reprojection_error() < MAX_ERROR and all(
        image.num_points3D >= MIN_SEEN for image in placed
    )
    return both if fits else None


def _add(both: Any, model: Any, image: Any) -> None:
    """Add an image of `model` with its pose to the model `both`, without the points that it sees."""
    pycolmap = pycolmap_module()
    if not both.exists_camera(image.camera_id):
        both.add_camera(model.camera(image.camera_id))
    old = model.frame(image.frame_id)
    if not both.exists_rig(old.rig_id):
        both.add_rig(model.rig(old.rig_id))
    frame = pycolmap.Frame()
    frame.frame_id, frame.rig_id = image.frame_id, old.rig_id
    frame.add_data_id(image.data_id)
    frame.rig_from_world = old.rig_from_world
    both.add_frame(frame)
    points = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
    new = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id, points2D=points)
    new.frame_id = image.frame_id
    both.add_image(new)
    both.register_frame(image.frame_id)
