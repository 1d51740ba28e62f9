"""Estimate cameras and points from matches between pictures, by COLMAP's incremental mapper (Schönberger and
Frahm, Structure-from-motion revisited, CVPR 2016).

COLMAP gets features and matches from here and never opens a picture: its own decoder knows few formats, and
crashes the process on some that it does not know.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotDone
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from player.errors import MissingExtraError
from player.progress import Progress
from vfr_bake.data.features import Features, match
from vfr_bake.data.threads import in_threads, n_threads

MIN_MATCHES = 15
MIN_FOR_PRINCIPAL_POINT = 20
SECONDS_BETWEEN_LOOKS = 0.1


@dataclass(frozen=True)
class Sensor:
    """The properties that pictures of one camera have in common. Pictures with equal sensors share
    intrinsics."""

    width: int
    height: int
    device: tuple[str, ...]
    """Maker, model and focal length from EXIF. Each is empty if EXIF lacks it; the tuple is empty if EXIF is
    damaged."""
    focal: float | None
    """Focal length in pixels, from EXIF; None if EXIF does not tell."""


@dataclass(frozen=True)
class Attempt:
    """Settings for drawing the two pictures that a model begins with."""

    first_angle: float
    """Smallest angle, in degrees, between the two rays to a point, for most of the points that the pictures
    share. COLMAP's own 16 give better distances; neighbouring pictures have 4, and share more points, by
    which a third picture can be placed."""
    seed: int


FIRST_ATTEMPT = Attempt(16.0, 0)
FURTHER_ATTEMPTS = (Attempt(4.0, 0), Attempt(16.0, 1), Attempt(4.0, 1))


@dataclass(frozen=True)
class Pair:
    """Two pictures with matches, enough of which agree with one geometry."""

    i: int
    j: int
    """Numbers of the pictures, in the order of their names; i < j."""
    matches: np.ndarray
    """[n, 2] uint32, indices of features of i and of j."""
    geometry: Any
    """The `pycolmap.TwoViewGeometry` that most matches agree with; it lists those that do."""


def pycolmap_module() -> Any:
    """Return pycolmap, silenced. Raises MissingExtraError."""
    try:
        import pycolmap
    except ImportError as error:
        raise MissingExtraError(
            "cameras: expected pycolmap to estimate them: pip install 'vfr-bake[poses]'"
        ) from error
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.logging.stderrthreshold = pycolmap.logging.FATAL.value
    return pycolmap


def write_database(
    database: Path,
    names: Sequence[str],
    sensors: Sequence[Sensor],
    features: Sequence[Features],
    pairs: Sequence[Pair],
) -> None:
    """Write the pictures, their cameras and features, and the matches and geometries of the pairs into a new
    COLMAP database. Pictures of the same `Sensor` share a camera."""
    pycolmap = pycolmap_module()
    rigs: dict[Sensor, tuple[int, int]] = {}
    numbers = []
    with closing(pycolmap.Database.open(database)) as db:
        for name, sensor, found in zip(names, sensors, features, strict=True):
            if sensor not in rigs:
                camera = colmap_camera(sensor)
                camera.camera_id = db.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(camera.sensor_id)
                rigs[sensor] = camera.camera_id, db.write_rig(rig)
            camera_id, rig_id = rigs[sensor]
            image = pycolmap.Image(name=name, camera_id=camera_id)
            image.image_id = db.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(image.data_id)
            db.write_frame(frame)
            db.write_keypoints(image.image_id, found.points.astype(np.float32))
            numbers.append(image.image_id)
        for pair in pairs:
            db.write_matches(numbers[pair.i], numbers[pair.j], pair.matches)
            db.write_two_view_geometry(numbers[pair.i], numbers[pair.j], pair.geometry)


def colmap_camera(sensor: Sensor) -> Any:
    """Return the camera that the estimation begins with: square pixels and two terms of radial distortion.

    The model OPENCV, with a second focal length and tangential terms, is no better on a full set of pictures;
    on a dozen from a short arc its two focal lengths drift apart by 5 %. Without EXIF the focal length begins
    at COLMAP's own guess, 1.2 times the longer side.
    """
    pycolmap = pycolmap_module()
    focal = sensor.focal or 1.2 * max(sensor.width, sensor.height)
    camera = pycolmap.Camera.create_from_model_name(1, "RADIAL", focal, sensor.width, sensor.height)
    camera.has_prior_focal_length = sensor.focal is not None
    return camera


def two_view_options() -> Any:
    """Return the options for estimating the geometry of a pair, with a fixed seed, so that every run gives
    the same."""
    options = pycolmap_module().TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    options.min_num_inliers = MIN_MATCHES
    return options


def match_pictures(
    sensors: Sequence[Sensor],
    features: Sequence[Features],
    pairs: Sequence[tuple[int, int]],
    progress: Progress,
    known: Callable[[int, int], np.ndarray | None] = lambda i, j: None,
    keep: Callable[[int, int, np.ndarray], object] = lambda i, j, matches: None,
) -> list[Pair]:
    """Match the `pairs` (i, j) of pictures, and return those of which enough matches agree with one geometry.

    `known`: returns the matches [n, 2] of a pair that has been matched before, or None; `keep`: called with
    the numbers and the matches of every other pair.
    """
    pycolmap = pycolmap_module()
    cameras = {sensor: colmap_camera(sensor) for sensor in set(sensors)}
    options = two_view_options()

    def geometry(pair: tuple[int, int]) -> Pair | None:
        i, j = pair
        matches = known(i, j)
        if matches is None:
            matches = match(features[i].descriptors, features[j].descriptors)
            keep(i, j, matches)
        if len(matches) < MIN_MATCHES:
            return None
        estimate = pycolmap.estimate_two_view_geometry(
            cameras[sensors[i]], features[i].points, cameras[sensors[j]], features[j].points, matches, options
        )
        return Pair(i, j, matches, estimate) if len(estimate.inlier_matches) >= MIN_MATCHES else None

    return [pair for pair in in_threads(geometry, pairs, progress) if pair is not None]


def map_pictures(
    database: Path,
    pictures: Path,
    work: Path,
    n_pictures: int,
    progress: Progress,
    attempt: Attempt = FIRST_ATTEMPT,
) -> list[Any]:
    """Build the `pycolmap.Reconstruction`s that the database's matches allow; returns the one of the most
    pictures first.

    `work`: a folder for COLMAP's own output. COLMAP runs in a thread of its own, so that an interruption can
    stop it by its token, between one picture and the next.
    """
    pycolmap = pycolmap_module()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = n_threads()
    options.random_seed = attempt.seed
    options.min_model_size = 3
    options.extract_colors = False
    options.mapper.init_min_tri_angle = attempt.first_angle
    token = pycolmap.CancellationToken()
    n_placed = 0

    def place(n_new: int) -> None:
        # COLMAP may begin another model from nothing; the count never goes back.
        nonlocal n_placed
        n_placed = min(n_placed + n_new, n_pictures)

    with ThreadPoolExecutor(1) as pool:
        future: Future[dict[int, Any]] = pool.submit(
            pycolmap.incremental_mapping,
            database,
            pictures,
            work,
            options,
            initial_image_pair_callback=lambda: place(2),
            next_image_callback=lambda: place(1),
            cancellation_token=token,
        )
        try:
            while True:
                progress(n_placed, n_pictures)
                try:
                    models = future.result(SECONDS_BETWEEN_LOOKS)
                    break
                except NotDone:
                    continue
        except BaseException:
            token.cancel()
            raise
    progress(n_pictures, n_pictures)
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def refine_principal_points(model: Any) -> None:
    """Refine the principal points, once, at the end, of the cameras that have taken enough pictures.

    A phone's principal point is off by a hundredth of the picture, which turns every pose by half a degree
    and leaves a pixel of error at the border. From few pictures this cannot be told from a turn of the
    camera.
    """
    n_taken = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    enough = {camera for camera, n in n_taken.items() if n >= MIN_FOR_PRINCIPAL_POINT}
    if enough:
        adjust(model, enough)


def adjust(model: Any, principal_points: Collection[int] = ()) -> None:
    """Adjust the cameras and points of a `pycolmap.Reconstruction` together (bundle adjustment). If there are
    `principal_points`, the numbers of cameras, these are refined, too, and the other cameras keep their
    intrinsics: COLMAP cannot keep a principal point alone."""
    pycolmap = pycolmap_module()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = bool(principal_points)
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    if principal_points:
        for camera in {*model.cameras} - {*principal_points}:
            config.set_constant_cam_intrinsics(camera)
    for image in model.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not `pycolmap.bundle_adjustment`, which writes to stderr whatever the log level.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
