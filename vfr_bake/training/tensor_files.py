"""Files of tensors and plain values: how models, checkpoints and weights are read and written.

Reading never runs code (`weights_only=True`); writing is beside the target and renamed, so that there is
always a whole file.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from pickletools import genops
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, ZipFile

import torch

from player.errors import FormatError
from player.files.files import file_size, open_file, write_bytes
from player.files.json_files import brief
from player.files.memory import allowed_bytes, check_memory

COPIES = 3
"""Copies of a file's tensors in memory at most: one is read, one is restored, one is checked."""
_PLAIN = re.compile(r"torch [A-Za-z0-9]+Storage|torch\._utils _rebuild_tensor_v2|collections OrderedDict")
"""The names that a pickle of tensors and plain values may contain."""


def write_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write `content`, tensors and plain values, to `path`."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_bytes(path, buffer.getvalue())


def read_tensors(path: Path, what: str, max_memory: float | None = None, from_elsewhere: bool = False) -> Any:
    """The content of `path`, on the CPU; `what` it should be goes into the error.

    Args:
        path: the file.
        what: what is expected there, for the message.
        max_memory: gigabytes that reading may take; a share of what the machine has if None.
        from_elsewhere: whether it may be a file that `write_tensors` has not written, as older versions of
            torch wrote them.

    Raises FormatError: there is no such file, it is not a regular one, or its bytes are not of that kind;
    ConfigError: it takes more memory than it may.

    >>> read_tensors(Path("nowhere.pt"), "a model")
    Traceback (most recent call last):
    player.errors.FormatError: nowhere.pt: no such file: expected a model
    """
    allowed = allowed_bytes(max_memory)
    check_memory(COPIES * file_size(path, what), allowed, str(path))
    with open_file(path, what, allowed) as file:
        if not from_elsewhere:
            _check_archive(file, path, what)
        try:
            content = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # torch.load has no documented set of errors for bad bytes
            raise FormatError(f"{path}: not {what}, or cut short") from error
    if not all(_is_whole(tensor) for tensor in _tensors(content)):
        raise FormatError(
            f"{path}: not {what}: expected all numbers of a tensor in the file, got one for many"
        )
    return content


def _check_archive(file: BinaryIO, path: Path, what: str) -> None:
    """Refuse an archive with more in it than its bytes, and a pickle that names anything but plain tensors:
    torch would inflate the one, and make objects of any size for the other."""
    try:
        with ZipFile(file) as archive:
            entries = archive.infolist()
            packed = any(entry.compress_type != ZIP_STORED for entry in entries)
            if packed or sum(entry.file_size for entry in entries) > os.fstat(file.fileno()).st_size:
                raise FormatError(f"{path}: not {what}: expected plain entries in it, got packed ones")
            pickles = [entry for entry in entries if entry.filename.endswith("data.pkl")]
            names = {name for entry in pickles for name in _globals(archive.read(entry))}
    except FormatError:
        raise
    except Exception as error:  # nor have zipfile and pickletools
        raise FormatError(f"{path}: not {what}, or cut short") from error
    finally:
        file.seek(0)
    unknown = sorted(name for name in names if not _PLAIN.fullmatch(name))
    if unknown:
        raise FormatError(f"{path}: not {what}: expected plain tensors and values, got {brief(unknown[0])}")


def check_plain(tensor: torch.Tensor, fits: bool, numbers: str, where: str) -> None:
    """Raises FormatError unless `tensor` `fits` and is dense; `numbers` are what it should hold, in words."""
    if not fits or tensor.layout is not torch.strided:
        got = f"{tensor.dtype}, {tensor.layout}".replace("torch.", "")
        raise FormatError(f"{where}: expected a plain tensor of {numbers}, got {got}")


def check_kinds(content: dict[str, Any], kinds: dict[str, type], where: str) -> None:
    """Raises FormatError unless the value of each key of `kinds` in `content` is of that kind."""
    for key, kind in kinds.items():
        if not isinstance(content.get(key), kind):
            raise FormatError(
                f"{where}: {key}: expected {kind.__name__}, got {type(content.get(key)).__name__}"
            )


def _tensors(content: Any) -> Iterator[torch.Tensor]:
    """Every tensor in plain values, once, however often it is referred to."""
    left, seen = [content], set()
    while left:
        value = left.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, dict):
            left += [*value.keys(), *value.values()]
        elif isinstance(value, list | tuple | set | frozenset):
            left += value


def _is_whole(tensor: torch.Tensor) -> bool:
    """Whether a tensor has its numbers in memory, each by itself, and not one in many places."""
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def _globals(pickle: bytes) -> Iterator[str]:
    """What a pickle names; the name of what is on its stack is not known, and none is ours."""
    for operation, argument, _ in genops(pickle):
        if operation.name == "GLOBAL":
            yield str(argument)
        elif operation.name in ("STACK_GLOBAL", "INST", "OBJ", "EXT1", "EXT2", "EXT4"):
            yield operation.name
