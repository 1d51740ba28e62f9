"""OpenEXR: one multi-layer picture, linear light, compressed without loss (ZIP).

| channel | type | meaning |
|---|---|---|
| `R G B A` | colour | linear light, Rec. 709 primaries, multiplied by A; A is the opacity |
| `Z` | float | mean depth along the camera's axis, world units |
| `distance.V` | float | mean depth along the ray: from the camera to the place, world units |
| `position.X .Y .Z` | float | the place at that distance, world frame |
| `normal.X .Y .Z` | colour | normal of the density, world frame, unit length (`player.march.normals`) |
| `opacity.V` | colour | A again, for programs that show a layer and not an alpha |
| `samples.V` | float | density samples that the player took |
| `features.00 ...` | colour | the head's input: sum of weight times feature, in units of the codes |

The type "colour" is half with `half=True`, else float. The depth is the MEAN of the distances along the ray,
weighted by compositing weight: where two surfaces are both seen, it lies between them. A pixel is hit if its
opacity is over 1/512, as for the player. In other pixels Z and distance are infinite, and everything but A,
opacity and samples is 0.

A name has one dot between the layer and a channel of one letter, so that Blender, Nuke and OpenImageIO group
the channels of a layer. The channels of the features have numbers, and Blender leaves them out.
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np

from exporters.extras import needs
from exporters.shapes.colour import linear_from_srgb
from player.cameras.camera import Camera
from player.errors import FormatError, OutputError, ParityError, ShapeError
from player.files.files import open_file
from player.march.march import MIN_OPACITY
from player.render import Frame

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities x, y of sRGB's primaries red, green and blue, and of its white."""

DEPTH = (
    "mean by compositing weight; Z along the camera's axis, distance.V along the ray; world units; "
    "infinite where A <= 1/512"
)

SOFTWARE = "vfr-export"
"""The attribute `software` of every picture written here."""
_HEADER_BYTES = 1 << 16  # more than the attributes of a picture written here take


def exr_channels(
    frame: Frame, camera: Camera, half: bool = False, places: bool = True
) -> dict[str, np.ndarray]:
    """Return the channels of a rendered frame, by name.

    Args:
        frame: rendered over no background ("transparent") and with `layers`.
        camera: the camera that the frame was rendered with, WORLD frame.
        half: 16 bits for the channels that hold colours, directions and features.
        places: whether float32 is fine enough for places in the world; if not, there is no `position`.

    Returns:
        name: [h, w] float16 or float32.

    Raises:
        ShapeError: the frame has a background, or no layers.
    """
    if frame.background != "transparent" or frame.features is None:
        raise ShapeError("EXR: frame: expected one over no background and with layers, got another")
    met = frame.opacity > MIN_OPACITY
    cosines, rays_d = _rays(camera)
    distance = frame.depth.astype(np.float64)
    position = camera.c2w[:3, 3] + distance[..., None] * rays_d
    rgb = np.where(met, frame.opacity, 0)[..., None] * linear_from_srgb(np.clip(frame.rgb, 0, 1))
    kind = np.float16 if half else np.float32
    parts: list[tuple[str, str | list[str], np.ndarray, Any]] = [
        ("", "RGB", rgb, kind),
        ("", "A", frame.opacity, kind),
        ("", "Z", np.where(met, distance * cosines, np.inf), np.float32),
        ("distance.", "V", np.where(met, distance, np.inf), np.float32),
        *([("position.", "XYZ", np.where(met[..., None], position, 0), np.float32)] if places else []),
        ("normal.", "XYZ", np.where(met[..., None], frame.normals, 0), kind),
        ("opacity.", "V", frame.opacity, kind),
        ("samples.", "V", frame.n_density_samples, np.float32),
        ("features.", [f"{k:02d}" for k in range(frame.features.shape[-1])], frame.features, kind),
    ]
    channels = {}
    for layer, names, values, dtype in parts:
        values = values.reshape(*frame.opacity.shape, len(names))
        for index, name in enumerate(names):
            channels[layer + name] = np.ascontiguousarray(values[..., index], dtype)
    return channels


def exr_header(camera: Camera, places: bool = True) -> dict[str, Any]:
    """Return the attributes of a picture: the meaning of its numbers, and its camera.

    `worldToCamera` and `worldToNDC` are OpenEXR's own, for ROW vectors (p' = p M). OpenEXR's camera space is
    left-handed: x right, y up, z ahead (ImfStandardAttributes.h). `vfr.cameraToWorld` is the c2w of
    transforms.json, for column vectors, and `vfr.intrinsics` the 3 x 3 matrix of fx, fy, cx, cy in pixels,
    pixel centres at +0.5. OpenEXR's own are in float32: without `places` (see `exr_channels`) they are left
    out.

    `screenWindowCenter` and `screenWindowWidth` are the middle and the width of the picture on the plane one
    unit ahead of the camera. There x is LEFT, and y up (OpenEXR's Technical Introduction).

    >>> header = exr_header(Camera("a", np.eye(4), 4, 2, 3.0, 3.0, 2.0, 1.0))
    >>> bool(np.allclose(np.array([0, 0, -5.0, 1]) @ header["worldToNDC"], [2.5, 2.5, 1, 5]))
    True
    """
    w2c = np.linalg.inv(camera.c2w)
    ndc_from_camera = np.array(
        [
            [camera.fx / camera.width, 0, -camera.cx / camera.width, 0],
            [0, -camera.fy / camera.height, -camera.cy / camera.height, 0],
            [0, 0, 0, 1],
            [0, 0, -1, 0],
        ]
    )
    matrices = {
        "worldToCamera": np.ascontiguousarray((np.diag([1, 1, -1, 1]) @ w2c).T, np.float32),
        "worldToNDC": np.ascontiguousarray((ndc_from_camera @ w2c).T, np.float32),
    }
    return {
        "chromaticities": REC709,
        "software": SOFTWARE,
        "screenWindowWidth": camera.width / camera.fx,
        "screenWindowCenter": np.array(
            [
                (camera.cx - camera.width / 2) / camera.fx,
                (camera.cy - camera.height / 2) / camera.fy,
            ],
            np.float32,
        ),
        **(matrices if places else {}),
        "vfr.camera": camera.name,
        "vfr.cameraToWorld": np.ascontiguousarray(camera.c2w, np.float64),
        "vfr.intrinsics": np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]),
        "vfr.colourSpace": "linear light, Rec. 709 primaries, RGB multiplied by A",
        "vfr.depth": DEPTH,
        "vfr.frame": "world",
    }


def write_exr(path: Path, channels: dict[str, np.ndarray], header: dict[str, Any]) -> None:
    """Write one file and read it back. This is not atomic; `exporters.pictures` writes into a folder that is.

    Args:
        path: the new file.
        channels: name: [h, w] float16 or float32, all of one size.
        header: attributes besides those that every file has.

    Raises:
        OutputError: the file cannot be written, for example because the disk is full.
        ParityError: the file does not hold the channels or the attributes.
        MissingExtraError: OpenEXR is not installed.
    """
    openexr = load_openexr()
    fixed = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    try:
        # given copies, because OpenEXR puts objects of its own into these dictionaries
        openexr.File({**header, **fixed}, dict(channels)).write(str(path))
        with openexr.File(str(path), separate_channels=True) as file:
            check_channels(path, channels, {name: c.pixels for name, c in file.channels().items()})
            _check_header(path, header, file.header())
    except RuntimeError as error:
        raise OutputError(f"{path}: cannot write: {error}") from error


def is_picture(path: Path) -> bool:
    """Return whether a file is a picture that was written here, as its attribute `software` says. This needs
    no OpenEXR."""
    try:
        with open_file(path, "a picture", sys.maxsize) as file:
            header = file.read(_HEADER_BYTES)
    except FormatError:  # a folder, or not readable
        return False
    software = b"software\0string\0" + struct.pack("<i", len(SOFTWARE)) + SOFTWARE.encode()
    return path.suffix == ".exr" and header.startswith(b"v/1\x01") and software in header


def load_openexr() -> Any:
    """Import OpenEXR, or raise MissingExtraError, which says how to install it; called before long work."""
    with needs("EXR", "OpenEXR"):
        import OpenEXR
    return OpenEXR


def check_channels(path: Path, expected: dict[str, np.ndarray], got: dict[str, np.ndarray]) -> None:
    """Raise ParityError unless the channels agree in name, type, shape and every bit of every value."""
    if set(expected) != set(got):
        raise ParityError(f"{path}: channels: expected {sorted(expected)}, got {sorted(got)}")
    for name, array in expected.items():
        other = got[name]
        if other.dtype != array.dtype or other.shape != array.shape:
            raise ParityError(
                f"{path}: {name}: expected {array.dtype} {array.shape}, got {other.dtype} {other.shape}"
            )
        wrong = (array != other) & ~(np.isnan(array) & np.isnan(other))
        if wrong.any():
            apart = np.full(array.shape, -2.0)
            apart[wrong] = np.nan_to_num(np.abs(array[wrong].astype(np.float64) - other[wrong]), nan=-1)
            row, column = np.unravel_index(apart.argmax(), apart.shape)
            raise ParityError(
                f"{path}: {name}: expected {array[row, column]:g}, got {other[row, column]:g} at row {row}, "
                f"column {column}, the worst of {int(wrong.sum())} pixels that differ"
            )


def _check_header(path: Path, expected: dict[str, Any], got: dict[str, Any]) -> None:
    for name, value in expected.items():
        other = got.get(name)
        if isinstance(value, str) or other is None:
            same = value == other
        else:
            same = np.allclose(value, other, rtol=1e-6, atol=0)
        if not same:
            raise ParityError(f"{path}: {name}: expected {value}, got {other}")


def _rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return each pixel's cosine to the camera's axis [h, w] and unit direction [h, w, 3], float64, computed
    as in `Camera.rays`."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = -(np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    x, y = np.meshgrid(x, y)
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
    cosines = 1 / np.linalg.norm(rays, axis=-1)
    return cosines, (rays * cosines[..., None]) @ camera.c2w[:3, :3].T
