"""No command runs code that lies in the current folder, for example in an asset that was downloaded."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from player.child import python_command

PLANTED = """import sys
if "posix" in sys.builtin_module_names:
    import posix as system
else:
    import nt as system
handle = system.open({marker!r}, system.O_WRONLY | system.O_CREAT | system.O_APPEND)
system.write(handle, b"{name}\\n")
system.close(handle)
"""
PACKAGES = {
    *(
        "player",
        "exporters",
        "vfr_bake",
        "numpy",
        "PIL",
        "onnxruntime",
        "numba",
        "llvmlite",
        "torch",
        "scipy",
    ),
    *("skimage", "onnx", "tyro", "tqdm", "xatlas", "open3d", "cv2", "yaml", "sitecustomize", "usercustomize"),
}
SMALL = [
    *("--n-levels", "4", "--max-resolution", "32", "--log2-table-size", "12", "--device", "cpu"),
    *("--head-width", "16", "--density-width", "16", "--occupancy-resolution", "16"),
    *("--batch-samples", "1024", "--pilot-steps", "5", "--steps", "20", "--eval-views", "0"),
]  # fmt: skip
BAKE = ["--resolution", "24", "--refine-steps", "1", "--mesh-resolution", "16", "--check-views", "1"]


def plant(folder: Path, marker: Path) -> None:
    """Write a file for every module that an interpreter could look for, and `encodings` as the folder that it
    is in Python, each of which appends its name to `marker` when it runs. Also write settings that would have
    numba keep compiled code, which it unpickles, in a folder beside `marker`."""
    for name in sorted(set(sys.stdlib_module_names) - set(sys.builtin_module_names) | PACKAGES):
        path = folder / f"{name}.py"
        if name == "encodings":
            path = folder / name / "__init__.py"
            path.parent.mkdir()
        path.write_text(PLANTED.format(marker=str(marker), name=name))
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {marker}.cache\n")


def command(folder: Path, *words: object) -> None:
    """Run an installed command in `folder`."""
    program, *arguments = map(str, words)
    here = Path(sys.executable).parent / program
    done = subprocess.run([here, *arguments], cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, f"{words}: {done.stderr[-2000:]}"


def test_no_command_runs_what_is_in_the_current_folder(
    small_data: Path, shells_folder: Path, tmp_path: Path
) -> None:
    """Each command runs in the folder of the data or the asset, as for somebody who has just unpacked it."""
    marker, model, asset = tmp_path / "ran", tmp_path / "model.pt", tmp_path / "asset"
    data, shells = (
        Path(shutil.copytree(folder, tmp_path / folder.name)) for folder in (small_data, shells_folder)
    )
    plant(data, marker)
    plant(shells, marker)
    command(data, "vfr-train", ".", model, *SMALL)
    command(data, "vfr-eval", model, ".", "--json", tmp_path / "eval.json")
    command(data, "vfr-bake", model, asset, *BAKE)
    command(shells, "vfr-play", ".", "--view", "0", "--size", "48x40", "--output", "frame.png")
    textured = ["--method", "density", "--faces", "200", "--texture", "256"]
    command(shells, "vfr-export", ".", "mesh.glb", *textured)
    plant(asset, marker)
    samples = ["--samples", "1", "--sizes", "16x16", "--frames", "2", "--views", "1"]
    command(asset, "vfr-bench", ".", "--data", data, "--model", model, *samples)
    assert not marker.exists(), f"these ran: {marker.read_text().split()}"
    assert not Path(f"{marker}.cache").exists(), "numba took its settings from the current folder"


def test_planted_files_run_where_a_process_looks_there(tmp_path: Path) -> None:
    """The planted files do run if an interpreter is started carelessly: the test above is able to fail."""
    marker = tmp_path / "ran"
    folder = tmp_path / "folder"
    folder.mkdir()
    plant(folder, marker)
    subprocess.run([sys.executable, "-c", "import json"], cwd=folder, capture_output=True, check=False)
    # Python 3.13 imports linecache before the program's first line, and stops, as the planted one is empty.
    assert set(marker.read_text().split()) & {"json", "linecache"}


@pytest.mark.parametrize("variable", ["", ".", "{folder}"])
def test_a_child_has_the_parents_modules_and_none_of_the_current_folder(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child finds the parent's modules and none of the current folder, even if PYTHONPATH, which a child
    reads before any line of its program, names that folder."""
    marker, folder, modules = tmp_path / "ran", tmp_path / "folder", tmp_path / "modules"
    folder.mkdir()
    modules.mkdir()
    plant(folder, marker)
    (modules / "of_the_caller.py").write_text(
        "import json, sys, exporters\nprint(json.dumps([__name__, sys.argv[1:], sys.path]))\n"
    )
    monkeypatch.setattr(sys, "path", ["", ".", str(modules), *sys.path])
    environment = os.environ | {"PYTHONPATH": variable.format(folder=folder)}
    done = subprocess.run(
        python_command("of_the_caller", "--ü", "a b"),
        cwd=folder, env=environment, capture_output=True, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    name, arguments, path = json.loads(done.stdout)
    assert (name, arguments) == ("__main__", ["--ü", "a b"])
    assert path[0] == str(modules) and all(Path(place).is_absolute() for place in path)
    assert not marker.exists(), f"these ran: {marker.read_text().split()}"


def test_a_bar_starts_no_process(tmp_path: Path) -> None:
    """A progress bar starts no process. A bar that other processes share would start one, with the current
    folder on its path, wherever multiprocessing does not fork, as on macOS; the start method `spawn` stands
    for that here."""
    program = (
        "import io, multiprocessing, sys; multiprocessing.set_start_method('spawn'); "
        "sys.stderr = io.StringIO(); sys.stderr.isatty = lambda: True; "
        "from player.progress import Bar; bar = Bar('a'); bar.count(1, 2); bar.close(); "
        "from multiprocessing.resource_tracker import _resource_tracker; "
        "print('50%' in sys.stderr.getvalue(), _resource_tracker._pid)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("True None\n", "")
