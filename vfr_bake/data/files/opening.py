"""Open photographs in the formats that cameras and phones write, within limits that hold before anything is
decoded.

Pillow reads the header of a file, which says how large the picture is. A picture of more pixels than Pillow's
own limit is refused before any of them is decoded. The format is told by a file's content and not by its
name: phones share JPEG files called `.heic`, and the other way round.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image, PngImagePlugin

from player.errors import FormatError, MissingExtraError
from player.files.files import open_file
from player.files.images import MAX_FILE_BYTES, open_picture

SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".heic", ".heif", ".hif", ".avif", ".webp", ".tif", ".tiff"),
)
"""Suffixes of photographs, in small or capital letters."""
FORMATS = ("JPEG", "PNG", "AVIF", "WEBP", "TIFF", "BMP")
"""Formats, by Pillow's names, that a photograph may have if it is not HEIC, whatever its file is called."""
HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1")
AVIF_BRANDS = (b"avif", b"avis")


@contextmanager
def open_photograph(path: Path) -> Iterator[Image.Image]:
    """Open a photograph by Pillow, as a context manager; its pixels are not decoded yet.

    Raises FormatError as `open_picture` does, and MissingExtraError for HEIC if pillow-heif is missing.
    """
    heic = is_heic(path)
    if heic:
        _read_heic_from_now_on(path)
    try:
        with open_picture(path, ("HEIF",) if heic else FORMATS) as picture:
            yield picture
    except FormatError as error:
        if not heic or isinstance(error.__cause__, Image.DecompressionBombError):
            raise
        raise FormatError(
            f"{path}: HEIC picture: cannot be read to its end: it is cut short or damaged: copy it again, or "
            "leave it out"
        ) from error


def is_heic(path: Path) -> bool:
    """Return whether the file begins as a HEIC picture does (ISO/IEC 23008-12, 10.2). Raises FormatError."""
    with open_file(path, "a picture", MAX_FILE_BYTES) as file:
        head = file.read(64)
    if head[4:8] != b"ftyp":
        return False
    n_bytes = min(int.from_bytes(head[:4], "big"), len(head))
    brands = [head[8:12], *(head[at : at + 4] for at in range(16, n_bytes, 4))]
    return any(brand in HEIF_BRANDS for brand in brands) and not any(b in AVIF_BRANDS for b in brands)


def exif_of(picture: Image.Image) -> Image.Exif:
    """Return the EXIF data of an opened photograph without decoding its pixels.

    Some programs write EXIF behind the pixels of a PNG, and Pillow decodes all pixels to get to it. Here the
    pixels are skipped.
    """
    if isinstance(picture, PngImagePlugin.PngImageFile) and "exif" not in picture.info and picture.fp:
        place = picture.fp.tell()
        picture.fp.seek(8)  # behind the signature
        while (head := picture.fp.read(8)) and head[4:] not in (b"eXIf", b"IEND"):
            picture.fp.seek(int.from_bytes(head[:4], "big") + 4, 1)  # the chunk and its checksum
        if head[4:] == b"eXIf":
            picture.info["exif"] = b"Exif\0\0" + picture.fp.read(int.from_bytes(head[:4], "big"))
        picture.fp.seek(place)
    return Image.Image.getexif(picture)


def _read_heic_from_now_on(path: Path) -> None:
    """Register pillow-heif, so that Pillow reads HEIC files. Raises MissingExtraError."""
    try:
        import pillow_heif
    except ImportError as error:
        raise MissingExtraError(
            f"{path}: HEIC picture: expected pillow-heif to read it: pip install 'vfr-bake[train]'"
        ) from error
    pillow_heif.register_heif_opener(thumbnails=False)
