"""Count how many small mistakes the tests find: one at a time is made in a copy, and its folder's tests are
run.

    nice python -m tests.reliability.mutate --count 60 --seed 0 --results mutations.json

Sites are drawn uniformly (`tests.reliability.mutate.sites`); equal seeds draw equal sites of equal code. A
mutation is killed if a test fails or never ends. The tests of the file itself run first, then those that
import it, then all others that reach it. Mutations whose effect nobody could see from outside are listed with
the reason in `equivalent.json`, and others are drawn in their place. Mutations that are in the results
already are not run again.
"""

from __future__ import annotations

import argparse
import ast
import gc
import importlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

import numba
import pytest

import vfr_bake  # noqa: F401  (before torch and numba: it tells OpenMP how to wait)
from tests.reliability.mutate.sites import Site, sites_of

REPOSITORY = Path(__file__).resolve().parents[3]
PACKAGES = ("player", "exporters", "vfr_bake", "tests")
FOLDERS = ("player", "vfr_bake/baking", "exporters", "vfr_bake/kernels")
"""Folders whose sites are drawn; each is tested by its package's tests, and by those for every package."""
TESTS = {"player": "tests/player", "vfr_bake": "tests/vfr_bake", "exporters": "tests/exporters"}
EVERYWHERE = ("tests/numerics", "tests/reliability")
LAST = ("test_viewer", "test_other_programs", "test_reliability", "test_cluster")
"""Long tests that start browsers and other programs, and so reach files that they do not import."""
EQUIVALENT = Path(__file__).with_name("equivalent.json")
BATCHES = (2, 5)
"""Numbers of test files that are run first, because collecting the others takes longer than these take."""
IMPORTED = ("torch", "scipy.special", "onnx", "onnxruntime", "PIL.Image", "trimesh", "mpmath")
"""Packages that many tests import, imported once here; the process of a mutation is a fork of this one."""
BROKEN = 99
"""Exit code of a child in which pytest itself did not run."""
STALLED_SECONDS = 200.0
"""Seconds after which a test counts as endless, so that the mistake counts as found."""


class Imports:
    """Which files of the repository import which, including imports inside functions."""

    def __init__(self, root: Path) -> None:
        paths = [
            p
            for folder in ("player", "exporters", "vfr_bake", "tests")
            for p in (root / folder).rglob("*.py")
        ]
        self.files = {path.relative_to(root).as_posix() for path in paths}
        self._imported = {file: set(self._of_file(root, file)) for file in self.files}

    def _of_file(self, root: Path, file: str) -> list[str]:
        names = []
        for node in ast.walk(ast.parse((root / file).read_bytes())):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        found = [path for name in names if (path := name.replace(".", "/") + ".py") in self.files]
        fixtures = (Path(file).parent / "conftest.py").as_posix()
        return [*found, *({fixtures} & self.files - {file})]

    def distances(self, file: str) -> dict[str, int]:
        """Return the number of imports between `file` and each file that reaches it; 0 for `file` itself."""
        found = {file: 0}
        edge = {file}
        while edge:
            edge = {
                other for other, imported in self._imported.items() if imported & edge and other not in found
            }
            found.update(dict.fromkeys(edge, max(found.values()) + 1))
        return found


def files_of_tests(imports: Imports, file: str) -> list[str]:
    """Return the tests for a mutation of `file`, the likeliest to fail first; its own examples lead."""
    distances = imports.distances(file)
    folders = (TESTS[file.split("/")[0]], *EVERYWHERE)
    reaching = [
        name
        for name in imports.files
        if name.startswith(folders)
        and Path(name).stem.startswith("test_")
        and (name in distances or Path(name).stem in LAST)
    ]

    def order(name: str) -> tuple[bool, bool, bool, int, str]:
        stem, folder = Path(name).stem, Path(name).parent.name
        return (
            stem != f"test_{Path(file).stem}",
            stem in LAST,
            folder != Path(file).parent.name,
            distances.get(name, 0),
            name,
        )

    return [file, *sorted(reaching, key=order)]


class Copy:
    """A copy of the repository in which one file at a time is changed."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "repository"
        self._kept = folder / "compiled"
        self._kept.mkdir(parents=True)
        listed = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
        names = subprocess.run(listed, cwd=REPOSITORY, capture_output=True, check=True).stdout.decode()
        for name in filter(None, names.split("\0")):
            if (REPOSITORY / name).is_file():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(REPOSITORY / name, self.root / name)
        self.imports = Imports(self.root)

    def run(self, site: Site, limit: float) -> dict[str, Any]:
        """Run the tests with the change, and return the outcome."""
        path = self.root / site.path
        whole, stat = path.read_bytes(), path.stat()
        stale = {Path(file).stem for file in self.imports.distances(site.path)}
        with tempfile.TemporaryDirectory(dir=self._kept.parent, ignore_cleanup_errors=True) as folder:
            compiled = Path(folder) / "compiled"
            shutil.copytree(
                self._kept,
                compiled,
                copy_function=os.link,
                ignore=lambda _, names: [n for n in names if n.split(".")[0] in stale],
            )
            path.write_bytes(site.applied(whole))
            try:
                outcome = self._outcome(
                    files_of_tests(self.imports, site.path), compiled, Path(folder), limit
                )
            finally:
                path.write_bytes(whole)
                os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            self._keep(compiled, stale)
        return {"name": site.name, "line": site.line, **outcome}

    def failing(self, reasons: set[str]) -> list[str]:
        """Return which of the tests that killed a mutation also fail without a change."""
        wrong = []
        with tempfile.TemporaryDirectory(dir=self._kept.parent, ignore_cleanup_errors=True) as folder:
            for reason in sorted(reasons):
                kind, _, test = reason.partition(" ")
                if kind in ("FAILED", "ERROR"):
                    end = time.monotonic() + STALLED_SECONDS
                    if self._pytest([test], self._kept, Path(folder), end) is not None:
                        wrong.append(test)
        return wrong

    def _keep(self, compiled: Path, stale: set[str]) -> None:
        """Keep for the next run what numba compiled of files that the change does not reach."""
        for path in compiled.rglob("*.nb?"):
            target = self._kept / path.relative_to(compiled)
            if path.name.split(".")[0] not in stale and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                os.link(path, target)
            elif path.name.split(".")[0] not in stale and path.suffix == ".nbi":
                path.replace(target)

    def _outcome(self, tests: list[str], compiled: Path, folder: Path, limit: float) -> dict[str, Any]:
        """Run the likeliest tests, then the others, and return the outcome."""
        begin = time.monotonic()
        end, by = begin + limit, None
        for first, last in itertools.pairwise((0, *BATCHES, len(tests))):
            some = tests[first:last]
            if by is None and some and time.monotonic() < end:
                by = self._pytest(some, compiled, folder, end)
        seconds = round(time.monotonic() - begin)
        left = by is None and time.monotonic() >= end
        return {"killed": by is not None, "by": by, "left": left, "seconds": seconds}

    def _pytest(self, tests: list[str], compiled: Path, folder: Path, end: float) -> str | None:
        """Return what failed; None if nothing failed before `end`."""
        said = folder / "said.txt"
        arguments = ["-x", "-q", "--tb=line", "-p", "no:cacheprovider", "--basetemp", str(folder / "pytest")]
        child = os.fork()
        if child == 0:
            code = BROKEN
            try:
                self._begin_child(said, compiled)
                code = int(pytest.main([*arguments, *tests]))
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        moved, size, code = time.monotonic(), 0, None
        while code is None and time.monotonic() < min(end, moved + STALLED_SECONDS):
            time.sleep(0.2)
            pid, status = os.waitpid(child, os.WNOHANG)
            code = os.waitstatus_to_exitcode(status) if pid else None
            if said.exists() and said.stat().st_size > size:
                moved, size = time.monotonic(), said.stat().st_size
        if code is None:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None if time.monotonic() >= end else "no end"
        lines = said.read_text(encoding="utf-8", errors="replace").splitlines()
        failed = [line.split(" - ")[0] for line in lines if line.startswith(("FAILED ", "ERROR "))]
        if code != 0 and not failed and code != -signal.SIGSEGV:
            raise RuntimeError(f"pytest ended with {code}: " + "\n".join(lines[-20:]))
        return (failed or ["a crash"])[0] if code else None

    def _begin_child(self, said: Path, compiled: Path) -> None:
        """Make this process like one started in the copy, with nothing of the repository imported yet."""
        os.setsid()
        os.chdir(self.root)
        output = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.environ.update(NUMBA_CACHE_DIR=str(compiled), PYTHONPATH=str(self.root))
        os.environ.setdefault("VFR_DATA", str(REPOSITORY.parent / "shared" / "data"))
        numba.config.CACHE_DIR = str(compiled)  # pyright: ignore[reportAttributeAccessIssue]
        sys.path[:] = [
            str(self.root),
            *(path for path in sys.path if Path(path or ".").resolve() != REPOSITORY),
        ]
        for name in [name for name in sys.modules if name.split(".")[0] in PACKAGES]:
            del sys.modules[name]
        gc.freeze()


def drawn_sites(seed: int) -> list[Site]:
    """Return all sites in the order in which they are drawn. All changes of one place count as one site."""
    places: dict[tuple[str, int, int], Site] = {}
    for folder in FOLDERS:
        for path in sorted((REPOSITORY / folder).rglob("*.py")):
            name = path.relative_to(REPOSITORY).as_posix()
            for site in sites_of(name, path.read_bytes()):
                place = (name, site.start, site.end)
                if place not in places or site.rank(seed) < places[place].rank(seed):
                    places[place] = site
    return sorted(places.values(), key=lambda site: site.rank(seed))


def is_compiled(site: Site) -> bool:
    """Return whether numba compiles the file anew. Such sites take longest, and are run last."""
    text = (REPOSITORY / site.path).read_text(encoding="utf-8")
    return any(
        word in text for word in ("import njit", "player.compiling", "player.compiled.lanes", "llvmlite")
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, required=True, help="JSON, read and written")
    parser.add_argument("--limit", type=float, default=3600.0, help="seconds for a mutation's tests")
    parser.add_argument("--again", action="store_true", help="run the survivors again")
    parser.add_argument("--list", action="store_true", help="say what would be drawn, and run nothing")
    options = parser.parse_args()
    equivalent: dict[str, str] = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    sites = drawn_sites(options.seed)
    skipped, chosen = [], []
    for site in sites:
        (skipped if site.name in equivalent else chosen).append(site)
        if len(chosen) == options.count:
            break
    if options.list:
        sys.stdout.write("".join(f"{site.line:4} {site.name}\n" for site in chosen))
        return 0
    known = {}
    if options.results.exists():
        known = {run["name"]: run for run in json.loads(options.results.read_text())["runs"]}
    with tempfile.TemporaryDirectory(prefix="vfr-mutate-", ignore_cleanup_errors=True) as folder:
        for name in IMPORTED:
            importlib.import_module(name)
        copy = Copy(Path(folder))
        for site in sorted(chosen, key=is_compiled):
            run = known.get(site.name)
            if run is None or (options.again and not run["killed"]):
                known[site.name] = run = copy.run(site, options.limit)
                sys.stderr.write(
                    f"{'killed' if run['killed'] else 'SURVIVED'} {run['seconds']:4} s  {site.name}\n"
                )
            runs = [known[other.name] for other in chosen if other.name in known]
            summary = {
                "seed": options.seed,
                "sites": len(sites),
                "drawn": len(runs),
                "killed": sum(run["killed"] for run in runs),
                "survived": [run["name"] for run in runs if not run["killed"]],
                "equivalent": {site.name: equivalent[site.name] for site in skipped},
                "runs": runs,
            }
            options.results.write_text(json.dumps(summary, indent=1, ensure_ascii=False) + "\n")
        wrong = copy.failing({str(run["by"]) for run in runs if run["killed"]})
    for test in wrong:
        sys.stderr.write(f"fails without a mutation too, so that its kills do not count: {test}\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
