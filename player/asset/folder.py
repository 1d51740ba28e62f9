"""Check the files in an asset's folder: their sizes and checksums must be those in the manifest."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from player.asset.manifest import FileEntry
from player.errors import FormatError, IntegrityError
from player.files.files import file_size, open_file, read_bytes
from player.files.memory import check_memory

MAX_HEAD_BYTES = 64 << 20
"""Ten times the largest head that can be baked: 1,024 channels into layers that are 256 wide take 6 MB."""
MAX_CAMERA_BYTES = 64 << 20


def check_files(folder: Path, files: Mapping[str, FileEntry], allowed: int) -> None:
    """Check files of an asset before any is opened: their sizes against the manifest, against the most that
    files of their kind can hold, and against the memory that is allowed.

    Raises FormatError: a file is not a regular one, outside the folder, or larger than any of its kind can
    be; IntegrityError: it has another size; ConfigError: the files are larger than what is allowed.
    """
    for name, entry in files.items():
        check_size(folder, name, entry)
    check_total(folder, files, allowed)
    for name, most in (("head.onnx", MAX_HEAD_BYTES), ("cameras.json", MAX_CAMERA_BYTES)):
        if files[name].bytes > most:
            raise FormatError(
                f"{folder / name}: size: expected at most {most} bytes, got {files[name].bytes}"
            )


def check_total(folder: Path, files: Mapping[str, FileEntry], allowed: int) -> None:
    """Raise ConfigError if files of an asset are together larger than the memory that is allowed."""
    check_memory(sum(entry.bytes for entry in files.values()), allowed, str(folder))


def check_size(folder: Path, name: str, entry: FileEntry) -> None:
    """Raise FormatError unless the file is a regular one inside the folder; IntegrityError if its size is not
    that in the manifest."""
    size = file_size(folder / name, f"a file of {entry.bytes} bytes", folder)
    if size != entry.bytes:
        raise IntegrityError(f"{folder / name}: size: expected {entry.bytes} bytes, got {size}")


def check_sum(folder: Path, name: str, entry: FileEntry) -> None:
    """Raise IntegrityError unless the file has the checksum in the manifest."""
    _compare_sums(folder / name, entry, file_digest(folder / name, entry.bytes, folder))


def read_checked(folder: Path, name: str, entry: FileEntry) -> bytes:
    """Return the content of a file of an asset, which has the size and the checksum in the manifest. Raises
    FormatError as `check_size`, and IntegrityError."""
    check_size(folder, name, entry)
    data = read_bytes(folder / name, "a file of an asset", entry.bytes, folder)
    _compare_sums(folder / name, entry, hashlib.sha256(data).hexdigest())
    return data


def _compare_sums(path: Path, entry: FileEntry, digest: str) -> None:
    """Raise IntegrityError unless `digest`, that of the file at `path`, is the one in the manifest."""
    if digest != entry.sha256:
        raise IntegrityError(f"{path}: sha256: expected {entry.sha256[:16]}..., got {digest[:16]}...")


def file_digest(path: Path, most: int, inside: Path) -> str:
    """Return the sha256, in hexadecimal digits, of a file of at most `most` bytes in the folder `inside`."""
    digest = hashlib.sha256()
    with open_file(path, "a file of an asset", most, inside) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
