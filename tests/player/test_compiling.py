"""Tests of which compiled code is kept, where, and when it is used again."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from numba.core import registry

from player import compiling, kept_code
from player.compiled.processor import target
from player.kept_code import N_KEPT, Place, place, sources_digest

USER = """
import sys
from pathlib import Path
import numba
from player import kept_code
from other import part

@numba.njit
def whole():
    return part() + 1

kept_code.keep(whole, Path(__file__).parent)
print(whole(), sum(whole.stats.cache_hits.values()))
"""
PART = """
import numba

@numba.njit
def part():
    return {}
"""
POSIX = os.name == "posix"


class Installation:
    """Two source files, one of which uses a function of the other, and a way to run them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.environment = folder, dict(os.environ)
        self.environment.pop("NUMBA_CACHE_DIR", None)
        self.environment["XDG_CACHE_HOME"] = str(folder.parent / "caches")
        folder.mkdir()
        (folder / "user.py").write_text(USER)
        self.write(1)

    def write(self, number: int) -> None:
        (self.folder / "other.py").write_text(PART.format(number))

    def run(self) -> str:
        """Run the files; return what the function gives, and how often its kept code was found."""
        command = [sys.executable, "-B", str(self.folder / "user.py")]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def kept(self, where: Path | None = None) -> list[str]:
        return sorted(path.name for path in (where or self.folder / "__pycache__").rglob("*.nbi"))


@pytest.fixture
def installation(tmp_path: Path) -> Installation:
    return Installation(tmp_path / "installed")


def test_a_change_in_another_file_is_compiled(installation: Installation) -> None:
    """A change in another file is compiled. numba's own cache would still give 2 the third time."""
    assert installation.run() == "2 0"
    first = installation.kept()
    assert first and installation.run() == "2 1" and installation.kept() == first
    installation.write(5)
    assert installation.run() == "6 0"
    installation.write(1)
    assert installation.run() == "2 1", "two versions that are used in turns keep their code"


def test_a_change_is_seen_in_a_folder_that_was_told(installation: Installation, tmp_path: Path) -> None:
    installation.environment["NUMBA_CACHE_DIR"] = str(tmp_path / "told")
    assert [installation.run(), installation.run()] == ["2 0", "2 1"]
    assert installation.kept(tmp_path / "told") and not (installation.folder / "__pycache__").exists()
    installation.write(5)
    assert installation.run() == "6 0"


def test_a_change_is_seen_in_an_installation_that_nobody_may_write_to(
    installation: Installation, tmp_path: Path
) -> None:
    """In a read-only installation, code is kept in the user's caches, and a change is seen. A file in place
    of the folder makes it read-only, since root may write anywhere."""
    (installation.folder / "__pycache__").touch()
    assert [installation.run(), installation.run()] == ["2 0", "2 1"]
    assert installation.kept(tmp_path)
    installation.write(5)
    assert installation.run() == "6 0"


@pytest.mark.parametrize("years", [-1, 1])
def test_clocks_and_sizes_say_nothing(years: int, installation: Installation) -> None:
    assert installation.run() == "2 0"
    installation.write(5)
    then = time.time() + years * 365 * 86400
    os.utime(installation.folder / "other.py", (then, then))
    assert installation.run() == "6 0"
    (installation.folder / "other.py").write_text(PART.format(7))
    os.utime(installation.folder / "other.py", (then, then))
    assert [installation.run(), installation.run()] == ["8 0", "8 1"]


def test_what_is_broken_is_compiled_again(installation: Installation) -> None:
    assert installation.run() == "2 0"
    for pattern, content in (("*.nbi", b""), ("*.nbc", b"no pickle")):
        for path in installation.folder.rglob(pattern):
            path.write_bytes(content)
        assert [installation.run(), installation.run()] == ["2 0", "2 1"]


def test_a_room_of_sources_counts_and_what_compiles_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "room").mkdir()
    (tmp_path / "a.py").write_text("1")
    digests = []
    for change in (
        lambda: None,
        lambda: (tmp_path / "room" / "b.py").write_text("2"),
        lambda: (tmp_path / "room" / "b.py").rename(tmp_path / "b.py"),
        lambda: monkeypatch.setattr(kept_code.numba, "__version__", "another"),
        lambda: monkeypatch.setattr(kept_code.llvmlite, "__version__", "another"),
        lambda: monkeypatch.setattr(kept_code.np, "__version__", "another"),
        lambda: monkeypatch.setattr(kept_code.sys, "version", "another"),
    ):
        change()
        sources_digest.cache_clear()
        digests.append(sources_digest(tmp_path))
    assert len(set(digests)) == len(digests)
    assert sources_digest(tmp_path / "none") is None and place(tmp_path / "none") == Place(None, "", None)


def test_every_kernel_and_march_has_all_its_sources() -> None:
    """The digest of the kernels covers the player's files too, since the kernels use their functions."""
    from vfr_bake.kernels import SOURCES, adam

    assert compiling.SOURCES in SOURCES and (SOURCES[0] / "adam.py").is_file()
    cache: Any = adam.adam_step._cache
    assert cache._impl.locator.get_source_stamp() == sources_digest(*SOURCES)
    assert sources_digest(*SOURCES) != sources_digest(SOURCES[0])


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of sources that is used for the first time."""
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "a.py").write_text("1")
    monkeypatch.setattr(kept_code.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    place.cache_clear()
    sources_digest.cache_clear()
    monkeypatch.setattr(compiling, "SOURCES", tmp_path / "package")
    return tmp_path / "package"


@pytest.fixture(autouse=True)
def forget() -> Any:
    yield
    place.cache_clear()
    sources_digest.cache_clear()


def test_first_use_is_known_by_what_is_kept(fresh: Path) -> None:
    assert compiling.first_use()
    folder = place(fresh).folder
    assert folder is not None and folder.parent == fresh / "__pycache__"
    (folder / "player.compiled.march._march_rays-33.py311.nbi").touch()
    assert not compiling.first_use() and compiling.not_kept() is None


def test_code_for_one_processor_is_not_run_as_another_s() -> None:
    """Keys of kept code have the processor's name and features, and thereby the length of vectors."""
    from player.compiled.march import _march_rays

    codegen: Any = registry.cpu_target.target_context
    dispatcher: Any = _march_rays
    assert dispatcher._cache._index_key((), codegen.codegen())[1] == target()


def test_old_code_is_removed(fresh: Path) -> None:
    """Old code is removed, but for the folders that were used last, whenever they were made."""
    folders = []
    for number in [*range(N_KEPT + 1), 0, N_KEPT + 1]:
        (fresh / "a.py").write_text(str(number))
        place.cache_clear()
        sources_digest.cache_clear()
        folder = place(fresh).folder
        assert folder is not None
        folders.append(folder)
        os.utime(folder, (len(folders), len(folders)))
    assert folders[0] == folders[N_KEPT + 1]
    assert sorted((fresh / "__pycache__").iterdir()) == sorted({*folders} - {folders[1]})


if POSIX:

    @pytest.mark.parametrize("mode", [0o777, 0o770, 0o1777, 0o702])
    def test_a_folder_that_others_may_write_to_is_not_used(
        mode: int, fresh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told = tmp_path / "told"
        told.mkdir()
        told.chmod(mode)
        monkeypatch.setattr(kept_code.config, "CACHE_DIR", str(told))
        assert place(fresh)[::2] == (None, told)
        assert compiling.first_use() and str(told) in (compiling.not_kept() or "")
        told.chmod(0o755)
        place.cache_clear()
        folder = place(fresh).folder
        assert folder is not None and folder.parent == told and folder.stat().st_mode & 0o777 == 0o700
        folder.chmod(mode)
        place.cache_clear()
        assert place(fresh)[::2] == (None, told)

    def test_a_folder_of_somebody_else_is_not_used(
        fresh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told = tmp_path / "told"
        told.mkdir()
        if os.geteuid() == 0:
            os.chown(told, 12345, -1)
        else:
            monkeypatch.setattr(kept_code.os, "geteuid", lambda: 12345)
        monkeypatch.setattr(kept_code.config, "CACHE_DIR", str(told))
        assert place(fresh)[::2] == (None, told)

    def test_beside_the_sources_the_folder_itself_is_asked(fresh: Path, tmp_path: Path) -> None:
        """The user's group, which has one member on many systems, may write beside the sources. If it may
        write in the folder of kept code itself, the user's caches are used instead."""
        (fresh / "__pycache__").mkdir()
        (fresh / "__pycache__").chmod(0o775)
        folder = place(fresh).folder
        assert folder is not None and folder.stat().st_mode & 0o777 == 0o700
        folder.chmod(0o770)
        place.cache_clear()
        of_user = place(fresh).folder
        assert of_user is not None and of_user.is_relative_to(tmp_path / "caches")

    def test_nothing_is_loaded_from_a_folder_that_others_may_write_to(
        installation: Installation, tmp_path: Path
    ) -> None:
        installation.environment["NUMBA_CACHE_DIR"] = str(tmp_path / "told")
        assert installation.run() == "2 0"
        (tmp_path / "told").chmod(0o777)
        assert installation.run() == "2 0"
        shutil.rmtree(tmp_path / "told")
