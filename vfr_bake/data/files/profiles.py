"""Colours of photographs that have a colour profile: phones write Display P3, and cameras Adobe RGB.

A picture's profile (ICC.1) says which colours its numbers stand for. Taken as sRGB, the numbers of a wider
space give duller colours.
"""

from __future__ import annotations

import io
import struct

import numpy as np
from PIL import Image, ImageCms

DISPLAY_P3 = {
    b"rXYZ": (0.51512, 0.24120, -0.00105),
    b"gXYZ": (0.29198, 0.69225, 0.04189),
    b"bXYZ": (0.15710, 0.06657, 0.78407),
}
"""Red, green and blue of Display P3, as XYZ under D50, by the names that they have in a profile."""


def coded_profile(head: bytes) -> bytes | None:
    """Return a colour profile that stands for the code that a HEIC or AVIF file may have instead of one; None
    unless it is that of Display P3, number 12 (ISO/IEC 23091-2, 8.1). `head`: the first bytes of the file.

    >>> coded_profile(b"no code") is None
    True
    """
    if head.partition(b"colrnclx")[2][:2] != b"\0\x0c":
        return None
    # The curve of sRGB is that of Display P3, too; its name is replaced because `as_srgb` looks at it.
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    for name, xyz in DISPLAY_P3.items():
        (place,) = struct.unpack_from(">I", profile, profile.index(name) + 4)
        struct.pack_into(">3i", profile, place + 8, *(round(65536 * value) for value in xyz))
    return bytes(profile).replace("sRGB".encode("utf-16-be"), "P3  ".encode("utf-16-be"))


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
