"""Reading and writing of files of tensors and plain values: models, checkpoints and weights.

Reading never runs code (`weights_only=True`). A file is written beside its target and then renamed, so that
there is always a whole file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from pickletools import genops
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, ZipFile

import torch

from player.errors import FormatError
from player.files.files import file_size, new_file, open_file
from player.files.json_files import brief
from player.files.memory import allowed_bytes, check_memory

COPIES = 3
"""Most copies of a file's tensors in memory at a time: one is read, one is restored, one is checked."""
MAX_VALUES = 2_000_000
"""The most values in a file, where one that is referred to twice counts twice, and 64 characters of a text
count as a value, too. So a file of a kilobyte cannot become gigabytes of JSON or of an error message."""
MAX_DEPTH = 64
"""The most lists and dicts inside one another; Python's own functions fail at some hundreds."""
_END = object()
_PLAIN = re.compile(r"torch [A-Za-z0-9]+Storage|torch\._utils _rebuild_tensor_v2|collections OrderedDict")
"""Names of functions and types that a pickle of tensors and plain values may contain."""


def write_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write `content`, which holds tensors and plain values, to `path`. It goes to the disk piece by piece: a
    checkpoint has hundreds of megabytes, which would take as much memory again. Raises OutputError."""
    with new_file(path) as temporary, temporary.open("xb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # torch closes its archive, which fails, too, and hides what stopped it
            if isinstance(error.__context__, OSError | KeyboardInterrupt):
                raise error.__context__ from None
            raise


def on_cpu(content: Any) -> Any:
    """Copy plain values, with every tensor in them moved to the CPU."""
    if isinstance(content, torch.Tensor):
        return content.cpu()
    if isinstance(content, dict):
        return {key: on_cpu(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return type(content)(on_cpu(value) for value in content)
    return content


def read_tensors(path: Path, what: str, max_memory: float | None = None, from_elsewhere: bool = False) -> Any:
    """Return the content of the file `path`, with its tensors on the CPU.

    Args:
        path: the file.
        what: what the file should be, for error messages.
        max_memory: gigabytes of memory that reading may take; None for a share of what the machine has.
        from_elsewhere: whether it may be a file that `write_tensors` has not written, such as one in the
            format of older versions of torch.

    Raises FormatError: the file does not exist, is not a regular file, or its bytes are not of that kind;
    ConfigError: reading it would take more memory than allowed.

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
        except Exception as error:  # torch.load does not document which errors it raises
            raise FormatError(f"{path}: not {what}, or cut short") from error
    _check_values(content, f"{path}: not {what}")
    return content


def _check_archive(file: BinaryIO, path: Path, what: str) -> None:
    """Check an archive before torch reads it; raises FormatError. Its entries must not be larger than the
    file, because torch would unpack them. Its pickle must name nothing but plain tensors, because torch would
    make objects of any size for other names."""
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
    except Exception as error:  # nor do zipfile and pickletools
        raise FormatError(f"{path}: not {what}, or cut short") from error
    finally:
        file.seek(0)
    unknown = sorted(name for name in names if not _PLAIN.fullmatch(name))
    if unknown:
        raise FormatError(f"{path}: not {what}: expected plain tensors and values, got {brief(unknown[0])}")


def check_plain(tensor: torch.Tensor, fits: bool, numbers: str, where: str) -> None:
    """Raise FormatError unless `fits` is true and `tensor` is dense; `numbers` says what it should hold."""
    if not fits or tensor.layout is not torch.strided:
        got = f"{tensor.dtype}, {tensor.layout}".replace("torch.", "")
        raise FormatError(f"{where}: expected a plain tensor of {numbers}, got {got}")


def check_kinds(content: Any, kinds: dict[str, type], where: str) -> None:
    """Raise FormatError unless `content` is a dict, in which the value of each key of `kinds` is of that
    kind."""
    if not isinstance(content, dict):
        raise FormatError(f"{where}: expected dict, got {type(content).__name__}")
    for key, kind in kinds.items():
        if not isinstance(content.get(key), kind):
            raise FormatError(
                f"{where}: {key}: expected {kind.__name__}, got {type(content.get(key)).__name__}"
            )


def _check_values(content: Any, where: str) -> None:
    """Raise FormatError if tensors in `content` are not whole, or if its plain values are more, deeper or
    larger than allowed."""
    left, n_values = [iter((content,))], 0.0
    while left:
        value = next(left[-1], _END)
        if value is _END:
            left.pop()
            continue
        n_values += 1 + (len(value) / 64 if isinstance(value, str | bytes) else 0)
        if n_values > MAX_VALUES:
            raise FormatError(f"{where}: expected at most {MAX_VALUES} values, got more")
        if isinstance(value, torch.Tensor) and not _is_whole(value):
            raise FormatError(f"{where}: expected all numbers of a tensor in the file, got one for many")
        if isinstance(value, dict):
            left.append(chain(value.keys(), value.values()))
        elif isinstance(value, list | tuple | set | frozenset):
            left.append(iter(value))
        if len(left) > MAX_DEPTH:
            raise FormatError(f"{where}: expected at most {MAX_DEPTH} values inside one another, got more")


def _is_whole(tensor: torch.Tensor) -> bool:
    """Return whether a tensor's storage has all of its numbers. If not, it shows one number in many
    places."""
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def _globals(pickle: bytes) -> Iterator[str]:
    """Yield the names in a pickle. For an operation that takes a name from the stack, where it is not known,
    yield the operation's own name, which is never allowed."""
    for operation, argument, _ in genops(pickle):
        if operation.name == "GLOBAL":
            yield str(argument)
        elif operation.name in ("STACK_GLOBAL", "INST", "OBJ", "EXT1", "EXT2", "EXT4"):
            yield operation.name
