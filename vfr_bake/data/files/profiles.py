"""Colours of photographs that have a colour profile: phones write Display P3, and cameras Adobe RGB.

A picture's profile (ICC.1) says which colours its numbers stand for. Taken as sRGB, the numbers of a wider
space give duller colours.
"""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageCms


def as_srgb(rgba: np.ndarray, profile: object) -> np.ndarray:
    """Return the sRGB colours of a picture [height, width, 4] uint8, straight alpha, whose colours are those
    of an ICC `profile`.

    Colours that sRGB does not have become the nearest on its border. A picture without a profile or with one
    of sRGB stays as it is; so does one whose profile is damaged, or is not for RGB.

    >>> as_srgb(np.full((1, 1, 4), 9, np.uint8), b"no profile").tolist()
    [[[9, 9, 9, 9]]]
    """
    if not isinstance(profile, bytes) or profile[16:20] != b"RGB ":
        return rgba
    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = ImageCms.getProfileDescription(own)
        if "sRGB" in name and "linear" not in name.lower():
            return rgba
        colours = ImageCms.profileToProfile(
            Image.fromarray(np.ascontiguousarray(rgba[..., :3])),
            own,
            ImageCms.createProfile("sRGB"),
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
        )
    except (ImageCms.PyCMSError, OSError):
        return rgba
    if colours is None:
        return rgba
    return np.concatenate([np.asarray(colours), rgba[..., 3:]], axis=-1)
