"""Tensor files that would take far more memory than their size, or that would make other objects."""

from __future__ import annotations

import collections
import errno
import io
import pickle
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from player.errors import ConfigError, FormatError, OutputError
from vfr_bake.training.tensor_files import read_tensors, write_tensors


def repacked(path: Path, method: int) -> None:
    with zipfile.ZipFile(path) as archive:
        entries = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)


def test_numbers_that_were_packed(tmp_path: Path) -> None:
    """Compressed entries are refused: torch would inflate them, to a thousand times the size of the file."""
    path = tmp_path / "model.pt"
    write_tensors(path, {"a": torch.zeros(10_000_000)})
    repacked(path, zipfile.ZIP_STORED)
    assert len(read_tensors(path, "a model")["a"]) == 10_000_000
    repacked(path, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 100_000
    with pytest.raises(FormatError, match=r"not a model: expected plain entries in it, got packed ones"):
        read_tensors(path, "a model")


def test_one_number_in_ten_thousand_million_places(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    write_tensors(path, {"a": [torch.zeros(1)], "b": (torch.zeros(1).expand(10_000_000_000),)})
    assert path.stat().st_size < 10_000
    with pytest.raises(FormatError, match=r"expected all numbers of a tensor in the file, got one for many"):
        read_tensors(path, "a model")


def test_memory_of_writing(tmp_path: Path) -> None:
    """Tensors go to the disk without a copy of the whole file in memory."""
    tensor = torch.zeros(10_000_000)
    tracemalloc.start()
    try:
        write_tensors(tmp_path / "model.pt", {"a": tensor})
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < tensor.nbytes / 10


@pytest.mark.parametrize(
    ("stopped_by", "told"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), OutputError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_writing_that_is_stopped_says_by_what(
    stopped_by: BaseException, told: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """torch closes its archive when a write fails, which fails, too, with an error that says nothing."""

    class Full(io.FileIO):
        n_written = 0

        def write(self, data: Any) -> int:
            if self.n_written > 50_000:
                raise stopped_by
            self.n_written += len(data)
            return super().write(data)

    monkeypatch.setattr(Path, "open", lambda path, mode: Full(path, mode))
    with pytest.raises(told, match="No space left" if told is OutputError else None):
        write_tensors(tmp_path / "model.pt", {"a": torch.zeros(100_000)})
    assert list(tmp_path.iterdir()) == []


def twice_in_the_next(inner: list, n_lists: int) -> list:
    for _ in range(n_lists):
        inner = [inner, inner]
    return inner


def test_values_that_refer_to_each_other(tmp_path: Path) -> None:
    """Lists that are each twice in the next can be read as long as few ways lead to the first. Thirty of them
    are refused: as JSON they would take gigabytes."""
    path = tmp_path / "model.pt"
    write_tensors(path, {"a": twice_in_the_next([torch.zeros(2)], 10)})
    assert len(read_tensors(path, "a model")["a"]) == 2
    endless: list = []
    endless.append(endless)
    deep: list = []
    for _ in range(100):
        deep = [deep]
    for values, message in [
        (twice_in_the_next([torch.zeros(2)], 30), "at most 2000000 values, got more"),
        (twice_in_the_next(["a" * 10_000], 20), "at most 2000000 values, got more"),
        (endless, "at most 64 values inside one another"),
        (deep, "at most 64 values inside one another"),
    ]:
        write_tensors(path, {"a": values})
        with pytest.raises(FormatError, match=f"not a model: expected {message}"):
            read_tensors(path, "a model")


def test_what_is_no_tensor(tmp_path: Path) -> None:
    """Objects other than tensors are refused, such as thirty bytes that make ten gigabytes of zeros: torch's
    own list of safe types lets these pass."""

    class Zeros:
        def __reduce__(self) -> tuple:
            return bytearray, (10_000_000_000,)

    path = tmp_path / "model.pt"
    torch.save({"a": Zeros(), "b": collections.OrderedDict(c=torch.zeros(2))}, path)
    with pytest.raises(FormatError, match=r"expected plain tensors and values, got \w+ bytearray"):
        read_tensors(path, "a model")


def test_what_older_versions_of_torch_wrote(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    torch.save({"a": torch.zeros(2)}, path, _use_new_zipfile_serialization=False)
    with pytest.raises(FormatError, match="not a model, or cut short"):
        read_tensors(path, "a model")
    assert len(read_tensors(path, "a model", from_elsewhere=True)["a"]) == 2
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(FormatError, match="not a model, or cut short"):
        read_tensors(path, "a model")


def test_memory(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    write_tensors(path, {"a": torch.zeros(1_000_000)})
    read_tensors(path, "a model", max_memory=0.013)
    with pytest.raises(ConfigError, match=r"model\.pt: memory: expected at most 0\.011 GB, got 0\.012 GB"):
        read_tensors(path, "a model", max_memory=0.011)
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(ConfigError, match="memory: expected at most"):
        read_tensors(path, "a model")
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(FormatError, match="expected a file, a model, got a device"):
        read_tensors(path, "a model")
