"""Picture quality against photographs; one implementation for training, baking and playing.

Pictures are [height, width, 3] with values in [0, 1]. PSNR = -10 log10(mean squared error). SSIM is that of
Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to structural
similarity", 2004, with a Gaussian window of standard deviation 1.5 cut at 11 x 11 pixels, K1 = 0.01 and K2 =
0.03: the mean over all windows that lie wholly inside the picture, and then over the channels.

Where pixels are masked, PSNR is that of the seen pixels, and SSIM is the mean over the windows whose middle
is seen; such a picture has no LPIPS, because the network's deeper layers mix seen and masked pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from player.errors import MissingExtraError, ShapeError
from player.files.images import to_8_bit

SSIM_WINDOW = 11
"""Width and height in pixels of SSIM's window, and so of the smallest picture that has an SSIM."""
VALUES_AT_ONCE = 3 * 2**20
"""Values, three a pixel, that are compared at once, so that large pictures need little memory."""

ROUNDING_ERROR = 1 / (12 * 255**2)
"""Mean square error of rounding to 8 bits. Pictures cannot be compared more closely."""
BRIGHTEST_ERROR = 0.25
"""Difference in [0, 1] from which on the error map is white; fixed, so that views can be compared."""

Distance = Callable[[np.ndarray, np.ndarray], float]
"""Distance between two pictures [height, width, 3] in [0, 1], 0 for equal ones; for example `lpips.Lpips`."""


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view against its photograph."""

    name: str
    psnr: float
    """PSNR in dB between 8-bit pictures; infinite where they are equal."""
    ssim: float | None
    """SSIM between 8-bit pictures; 1 where they are equal, None where no window fits whose middle is seen."""
    psnr_float: float
    """PSNR in dB between the pictures before they are rounded to 8 bits."""
    ssim_float: float | None
    """SSIM between the pictures before they are rounded to 8 bits."""
    lpips: float | None
    """LPIPS between 8-bit pictures; 0 where they are equal, None where it was not asked for or a pixel is
    masked."""


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB of two pictures with values in [0, 1]; infinite if equal.

    Raises ShapeError: the pictures differ in shape.

    >>> round(psnr(np.zeros((2, 2, 3)), np.full((2, 2, 3), 0.1)), 3)
    20.0
    """
    _check_same_shape(a, b)
    total = sum(float(((a[rows].astype(np.float64) - b[rows]) ** 2).sum()) for rows in _rows_at_once(a))
    return decibels(total / a.size)


def decibels(error: float) -> float:
    """Return the PSNR in dB for a mean square error of values in [0, 1]; infinite for 0, NaN for NaN.

    >>> round(decibels(0.01), 3), decibels(0.0), decibels(math.nan)
    (20.0, inf, nan)
    """
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(a: np.ndarray, b: np.ndarray, seen: np.ndarray | None = None) -> float | None:
    """Return the structural similarity of two pictures [height, width, 3] with values in [0, 1]; 1 if equal.

    `seen` [height, width] bool: the pixels that are not masked. Only windows around these count; None if
    there is no such window, or if the pictures are smaller than one. It is computed in float32, in half the
    time of float64 and within 1e-5 of it; figures are given to four decimals.

    Raises ShapeError: the pictures differ in shape or are not [height, width, 3]; MissingExtraError:
    scikit-image is not installed.

    >>> grey = np.full((16, 16, 3), 0.5)
    >>> ssim(grey, grey), round(ssim(grey, grey + 0.25), 4)  # (2 m n + C1) / (m^2 + n^2 + C1), C1 = 1e-4
    (1.0, 0.9231)
    >>> ssim(grey[:10], grey[:10]) is None
    True
    """
    _check_same_shape(a, b)
    if a.ndim != 3 or a.shape[2] != 3:
        raise ShapeError(f"ssim: expected [height, width, 3], got {list(a.shape)}")
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise MissingExtraError("ssim: needs scikit-image: pip install 'vfr-bake[train]'") from error
    if min(a.shape[:2]) < SSIM_WINDOW:
        return None
    border = SSIM_WINDOW // 2
    middles = (slice(border, -border),) * 2
    total, n_values = 0.0, 0
    for rows in _rows_at_once(a, 2 * border):
        similarity = structural_similarity(
            np.asarray(a[rows], np.float32),
            np.asarray(b[rows], np.float32),
            data_range=1,
            channel_axis=2,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            full=True,
        )[-1]
        values = similarity[middles] if seen is None else similarity[middles][seen[rows][middles]]
        total += float(values.sum(dtype=np.float64))
        n_values += values.size
    return total / n_values if n_values else None


def score_view(
    name: str,
    rgb: np.ndarray,
    photograph: np.ndarray,
    lpips: Distance | None = None,
    seen: np.ndarray | None = None,
) -> ViewScore:
    """Return all scores of a picture against its photograph, both [height, width, 3] in [0, 1], not rounded.

    `lpips`: a distance to measure on the 8-bit pictures as well. `seen` [height, width] bool: the pixels that
    count, at least one; None for all. Where others are masked, the two pictures should be equal, because
    windows of SSIM around seen pixels reach there.

    >>> score = score_view("grey", np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.501))
    >>> score.psnr, round(score.psnr_float), score.lpips
    (inf, 60, None)
    """
    if seen is not None and seen.all():
        seen = None
    rgb_8_bit, photograph_8_bit = to_8_bit(rgb) / 255, to_8_bit(photograph) / 255
    counted = slice(None) if seen is None else seen
    return ViewScore(
        name=name,
        psnr=psnr(rgb_8_bit[counted], photograph_8_bit[counted]),
        ssim=ssim(rgb_8_bit, photograph_8_bit, seen),
        psnr_float=psnr(rgb[counted], photograph[counted]),
        ssim_float=ssim(rgb, photograph, seen),
        lpips=None if lpips is None or seen is not None else lpips(rgb_8_bit, photograph_8_bit),
    )


def mean_scores(scores: Sequence[ViewScore]) -> dict[str, float | None]:
    """Return the mean of every score over at least one view, by its name in `ViewScore`; None where a view
    has None.

    >>> mean_scores([ViewScore("a", 20, 0.5, 21, 0.5, None), ViewScore("b", 30, 1, 31, 1, None)])
    {'psnr': 25.0, 'ssim': 0.75, 'psnr_float': 26.0, 'ssim_float': 0.75, 'lpips': None}
    """
    rows = [asdict(score) for score in scores]
    columns = {key: [row[key] for row in rows] for key in rows[0] if key != "name"}
    return {key: mean(values) for key, values in columns.items()}


def mean(values: Sequence[float | None]) -> float | None:
    """Return the mean of at least one value, or None if one of them is None."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def over_background(rgba: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Put straight-alpha uint8 pictures [..., 4] over a background [3] in [0, 1]; return float32 [..., 3] in
    [0, 1]."""
    values = rgba.astype(np.float32) / 255
    alpha = values[..., 3:]
    return values[..., :3] * alpha + (1 - alpha) * background.astype(np.float32)


def comparison(photograph: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Return photograph | rendered | error map side by side, [height, 3 width, 3] uint8.

    `photograph`, `rgb`: [height, width, 3] in [0, 1].

    Raises ShapeError: the pictures are not [height, width, 3] of one size.

    >>> comparison(np.zeros((4, 5, 3)), np.ones((4, 5, 3))).shape
    (4, 15, 3)
    """
    if photograph.shape != rgb.shape or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ShapeError(
            f"pictures: expected [height, width, 3] twice, got {list(photograph.shape)} and {list(rgb.shape)}"
        )
    return np.concatenate([to_8_bit(photograph), to_8_bit(rgb), error_map(photograph, rgb)], axis=1)


def error_map(photograph: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Return the largest difference of the three channels as a colour [height, width, 3] uint8.

    Equal pixels are black; larger differences go through red and yellow to white, from `BRIGHTEST_ERROR` on.

    >>> error_map(np.zeros((1, 3, 3)), np.array([[[0, 0, 0], [0, 0.25 / 3, 0], [1, 1, 1]]])).tolist()
    [[[0, 0, 0], [255, 0, 0], [255, 255, 255]]]
    """
    error = np.abs(photograph.astype(np.float64) - rgb).max(axis=2, keepdims=True) / BRIGHTEST_ERROR
    return to_8_bit(3 * error - np.arange(3))


def _check_same_shape(a: np.ndarray, b: np.ndarray) -> None:
    if a.shape != b.shape:
        raise ShapeError(f"pictures: expected one shape, got {list(a.shape)} and {list(b.shape)}")


def _rows_at_once(picture: np.ndarray, overlap: int = 0) -> Iterator[slice]:
    """Yield slices of the rows of a picture, of about VALUES_AT_ONCE values and of `overlap` rows more, which
    are the first ones of the next slice."""
    n_rows = max(VALUES_AT_ONCE // max(picture[:1].size, 1), 1)
    for first in range(0, len(picture) - overlap, n_rows):
        yield slice(first, first + n_rows + overlap)
