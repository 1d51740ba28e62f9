"""Files of tensors and plain values: how models, checkpoints and weights are read and written.

Reading never runs code (`weights_only=True`); writing is beside the target and renamed, so that there is
always a whole file.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from player.errors import FormatError
from player.files import write_bytes


def write_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write `content`, tensors and plain values, to `path`."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_bytes(path, buffer.getvalue())


def read_tensors(path: Path, what: str) -> Any:
    """The content of `path`, on the CPU; `what` it should be goes into the error.

    Raises FormatError: there is no such file, or its bytes are not of that kind.

    >>> read_tensors(Path("nowhere.pt"), "a model")
    Traceback (most recent call last):
    player.errors.FormatError: nowhere.pt: no such file: expected a model
    """
    if not path.is_file():
        raise FormatError(f"{path}: no such file: expected {what}")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load has no documented set of errors for bad bytes
        raise FormatError(f"{path}: not {what}, or cut short") from error
