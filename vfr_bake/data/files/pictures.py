"""Read picture files, turn them upright, and undo lens distortion."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from player.cameras.camera import Camera
from player.errors import DataError, FormatError, MissingExtraError
from player.files.files import open_file, read_bytes
from player.files.images import BAND, MAX_FILE_BYTES
from vfr_bake.data.files.opening import open_photograph
from vfr_bake.data.files.orientation import PictureHeader, as_stored, layout_of, read_layout, turned_upright
from vfr_bake.data.files.profiles import as_srgb, coded_profile

SHARPNESS_SIDE = 800
"""Pixels of the longest side at which sharpness is measured. Blur that does not show at this size is below
two pixels at the working size."""

BYTES_DECODED = 16
"""Bytes of memory for each decoded pixel while its picture is read."""
HEADER_BYTES = 1 << 16
"""Bytes at the beginning of a HEIC or AVIF file, at most, in which its colours are named."""


class DescribedView(NamedTuple):
    """A picture file with the camera that a data set describes."""

    path: Path
    camera: Camera
    """The camera. If its size differs from that of the picture, it is scaled to the picture when the picture
    is read."""
    distortion: dict[str, float]
    """Keyword arguments of `undistort`."""
    upright: bool = False
    """Whether the camera belongs to the picture turned upright, and not to the pixels as stored."""
    mask: Path | None = None
    """A picture that is black where this one is masked."""


def viewed_size(view: DescribedView) -> tuple[int, int]:
    """Return the width and height of a view's picture, turned as its camera is, without decoding the file.
    Raises DataError."""
    return picture_size(view.path, view.upright)


def picture_size(path: Path, upright: bool = False) -> tuple[int, int]:
    """Return the width and height of a picture as `read_picture` returns it, without decoding the file.
    Raises DataError."""
    layout = picture_layout(path)
    return layout.upright_size if upright else layout.size


def picture_layout(path: Path) -> PictureHeader:
    """Return what the header of a picture says. Raises DataError."""
    try:
        return read_layout(path)
    except FormatError as error:
        raise DataError(str(error)) from error


def premultiplied(image: np.ndarray) -> np.ndarray:
    """Return the picture with premultiplied alpha, [height, width, 4] float32 in [0, 255]. Means must be
    taken of this, because colours under zero alpha mean nothing."""
    weighted = image.astype(np.float32)
    weighted[..., :3] *= weighted[..., 3:] / 255
    return weighted


def straight(weighted: np.ndarray) -> np.ndarray:
    """Return the picture with straight alpha, [height, width, 4] uint8: the inverse of `premultiplied`. It
    works in place, and changes `weighted`."""
    weighted[..., :3] /= np.maximum(weighted[..., 3:], 1e-6) / 255
    return (weighted + 0.5).clip(0, 255).astype(np.uint8)


def enough_for(size: tuple[int, int], side: int) -> tuple[int, int]:
    """Return the width and height of a picture of this `size` once it is reduced so that no side is longer
    than `side`.

    >>> enough_for((4000, 3000), 1600), enough_for((40, 30), 1600)
    ((1600, 1200), (40, 30))
    """
    scale = min(1.0, side / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def decoding_bytes(path: Path, side: int | None = None) -> int:
    """Return the approximate number of bytes of memory that are taken while a picture is read at its own
    size, or, with a `side`, as `read_picture` reads it if that many pixels along a side are enough. It is 1
    for a file that cannot be read."""
    try:
        with open_photograph(path) as file:
            if side is not None:
                file.draft(None, enough_for(file.size, side))
            return file.size[0] * file.size[1] * BYTES_DECODED
    except (FormatError, MissingExtraError):
        return 1


def read_picture(path: Path, upright: bool = False, least: tuple[int, int] | None = None) -> np.ndarray:
    """Read a picture as [height, width, 4] uint8, sRGB and straight alpha; grey, palette and 16-bit pictures
    and those with another colour profile, too.

    `upright`: the picture is turned as EXIF says that it is to be looked at; otherwise it is as stored.
    `least`: a width and height that are enough for the returned picture. A JPEG file that is twice, four or
    eight times as large is then decoded at a half, a quarter or an eighth of its size, rounded up, in a
    fraction of the time.

    Raises DataError for what Pillow cannot read to its end, and for floating-point pictures.
    """
    try:
        with open_photograph(path) as file:  # also for 16 bits, so that the same limits hold
            layout = layout_of(file)
            if least is not None:
                swapped = upright != layout.turned and layout.number >= 5
                file.draft(None, (least[1], least[0]) if swapped else least)
            rgba = _read_16_bit_colour(path) if _is_16_bit_colour(path) else _decoded(path, file)
            rgba = as_srgb(rgba, file.info.get("icc_profile") or _coded_profile(path, file))
    except FormatError as error:
        raise DataError(str(error)) from error
    if layout.turned == upright:
        return rgba
    return turned_upright(rgba, layout.number) if upright else as_stored(rgba, layout.number)


def _decoded(path: Path, file: Image.Image) -> np.ndarray:
    file.load()
    if file.mode == "I" or file.mode.startswith("I;16"):
        # Pillow's own conversion clips 16-bit greys at 255.
        grey = _as_8_bit(np.asarray(file.convert("I")))
        rgba = np.full((*grey.shape, 4), 255, np.uint8)
        rgba[..., :3] = grey[..., None]
        return rgba
    if file.mode == "F":
        raise DataError(f"{path}: picture: expected 8 or 16 bits a channel, got floating point")
    return np.asarray(file.convert("RGBA"))


def _coded_profile(path: Path, file: Image.Image) -> bytes | None:
    """Return the colour profile that a HEIC or AVIF picture names by a code; None if it names none."""
    if file.format not in ("HEIF", "AVIF"):
        return None
    with open_file(path, "a picture", MAX_FILE_BYTES) as header:
        return coded_profile(header.read(HEADER_BYTES))


def _is_16_bit_colour(path: Path) -> bool:
    """Return whether a PNG has 16-bit colour channels, whose lower bytes Pillow would drop."""
    with open_file(path, "a picture", MAX_FILE_BYTES) as file:
        header = file.read(26)
    return (
        header[:8] == b"\x89PNG\r\n\x1a\n" and header[24:25] == b"\x10" and header[25:26] in b"\x02\x04\x06"
    )


def _read_16_bit_colour(path: Path) -> np.ndarray:
    cv2 = opencv(f"{path}: 16-bit picture: expected OpenCV to read it", "train")
    file = np.frombuffer(read_bytes(path, "a picture", MAX_FILE_BYTES), np.uint8)
    values = cv2.imdecode(file, cv2.IMREAD_UNCHANGED)  # as stored
    del file  # of noise, it has as many bytes as the values
    if values is None or values.dtype != np.uint16:
        raise DataError(f"{path}: picture: cannot be read to its end")
    values = _as_8_bit(values)
    if values.ndim == 2:
        values = values[..., None].repeat(3, axis=-1)
    if values.shape[2] == 2:  # grey and alpha
        values = values[..., [0, 0, 0, 1]]
    rgba = np.full((*values.shape[:2], 4), 255, np.uint8)
    rgba[..., :3] = values[..., 2::-1]  # OpenCV has blue first
    if values.shape[2] == 4:
        rgba[..., 3] = values[..., 3]
    return rgba


def _as_8_bit(values: np.ndarray) -> np.ndarray:
    """Return 16-bit values as 8-bit ones, a few rows at a time: 32-bit products of all of them would take
    more memory than BYTES_DECODED allows."""
    levels = np.empty(values.shape, np.uint8)
    n_rows = max(BAND * len(values) // values.size, 1)
    for first in range(0, len(values), n_rows):
        rows = slice(first, first + n_rows)
        levels[rows] = (values[rows].clip(0, 65535).astype(np.uint32) * 255 + 32767) // 65535
    return levels


def opencv(wanted: str, extra: str = "poses") -> Any:
    """Return OpenCV. Raises MissingExtraError, which says what was `wanted` and which `extra` of this project
    brings OpenCV."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(f"{wanted}: pip install 'vfr-bake[{extra}]'") from error
    return cv2


def sharpness(cv2: Any, image: np.ndarray) -> float:
    """Return the mean square of the Laplacian of the grey levels of a picture, [height, width, 3 or 4] uint8,
    where it is not transparent.

    Blur in any direction lowers it. It is for finding the sharpest of several pictures that show the same: a
    plain wall has none. Which pictures of a capture are blurred is found by `vfr_bake.data.quality`.
    """
    small = shrunk(cv2, image, SHARPNESS_SIDE)
    squares = np.square(cv2.Laplacian(cv2.cvtColor(small[..., :3], cv2.COLOR_RGB2GRAY), cv2.CV_32F))
    if small.shape[2] == 4:
        squares = squares[small[..., 3] > 127]
    return float(squares.mean()) if squares.size else 0.0


def shrunk(cv2: Any, image: np.ndarray, side: int, interpolation: int | None = None) -> np.ndarray:
    """Return a picture reduced by OpenCV until no side is longer than `side` pixels, by areas unless an
    `interpolation` is given."""
    if max(image.shape[:2]) <= side:
        return image
    size = enough_for((image.shape[1], image.shape[0]), side)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if interpolation is None else interpolation)


def undistort(
    image: np.ndarray,
    camera: Camera,
    k1: float = 0.0,
    k2: float = 0.0,
    k3: float = 0.0,
    k4: float = 0.0,
    p1: float = 0.0,
    p2: float = 0.0,
) -> np.ndarray:
    """Return the picture that `camera` would have taken without lens distortion; same size, same intrinsics.

    The lens model is OpenCV's with nerfstudio's fourth radial term: with r² = x² + y² at x, y = ray / depth,
    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + 2 p1 x y + p2 (r² + 2 x²), and y' likewise with x, y and p1,
    p2 exchanged. (`cv2.undistort` has no k4 of this meaning.) Pixels that the lens never saw repeat the
    picture's edge.

    `image`: [height, width, 4] uint8. Raises MissingExtraError without OpenCV.
    """
    cv2 = opencv(f"{camera.name}: lens distortion: expected OpenCV to undo it", "train")
    x = (np.arange(camera.width) + 0.5 - camera.cx)[None, :] / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy)[:, None] / camera.fy
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    column = camera.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + camera.cx - 0.5
    row = camera.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + camera.cy - 0.5
    result = cv2.remap(
        premultiplied(image),
        column.clip(-1e6, 1e6).astype(np.float32),
        row.clip(-1e6, 1e6).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return straight(result)
