"""Which package may import what, checked in the source and in a process in which torch cannot be imported.
The way of a ray in docs/architecture.md is compared with the code."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from graphlib import TopologicalSorter
from pathlib import Path
from types import FrameType

import pytest
from packaging.requirements import Requirement

from player.asset.asset import Asset
from player.cameras.views import asset_cameras
from player.render import Renderer

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGES = ("player", "exporters", "vfr_bake")
MAX_LINES = 500

# Packages that may be imported nowhere in these packages, not even inside a function.
FORBIDDEN = {
    "player": {
        *("exporters", "vfr_bake", "torch", "triton", "scipy", "cv2", "skimage", "onnx", "tqdm", "tyro"),
        *("dask", "trimesh", "imageio"),  # dependencies of viser and distributed
    },
    "exporters": {"vfr_bake", "torch", "triton", "cv2", "tqdm", "tyro", "trimesh", "OpenImageIO"},
    "vfr_bake": {"trimesh", "open3d", "lpips", "torchvision"},
}
# Packages that may be imported only inside functions, so that none is needed to import one of our packages.
LAZY = {
    "player": {"numba", "PIL", "onnxruntime", "viser", "websockets", "msgspec", "av", "distributed"},
    "exporters": {
        *("onnx", "onnxruntime", "skimage", "scipy", "numba", "PIL", "OpenEXR", "open3d", "pxr", "xatlas"),
    },
    "vfr_bake": {
        "onnx",
        "onnxruntime",
        "skimage",
        "tyro",
        "tqdm",
        "cv2",
        "scipy",
        "triton",
        "pycolmap",
        "pillow_heif",
    },
}
# Modules that are of no use without the package beside them and import it at the top level. Other modules
# import these modules inside functions.
TOP_LEVEL_EXCEPTIONS = {
    *(
        (f"player/compiled/{name}.py", "numba")
        for name in (
            "processor",
            "lanes",
            "packets",
            "fetches",
            "prefetch",
            "add_rows",
        )
    ),
    *((f"player/{name}.py", "numba") for name in ("compiling", "kept_code")),
    *((f"player/head/{name}.py", "numba") for name in ("activations", "dense_tiles")),
    ("vfr_bake/options.py", "tyro"),
    ("player/viewer/guard.py", "websockets"),
    ("player/viewer/messages.py", "msgspec"),
}

MODULES = sorted(path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py"))
IDS = [path.relative_to(REPOSITORY).as_posix() for path in MODULES]


def imported(tree: ast.AST, top_level: bool) -> Iterator[str]:
    """Yield the first part of every imported name; with `top_level` only of those imports that run when the
    module is imported."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield (node.module or "").split(".")[0] if node.level == 0 else "."
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            yield from imported(ast.Module(node.orelse, []), top_level)
        elif not (
            top_level and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.Try)
        ):
            yield from imported(node, top_level)


@pytest.mark.parametrize("path", MODULES, ids=IDS)
def test_imports_go_one_way(path: Path) -> None:
    package = path.relative_to(REPOSITORY).parts[0]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    everywhere = set(imported(tree, top_level=False))
    assert not everywhere & FORBIDDEN[package]
    assert "." not in everywhere, "relative imports: write the whole name"
    heavy = set(imported(tree, top_level=True)) & LAZY[package]
    name = path.relative_to(REPOSITORY).as_posix()
    assert not {module for module in heavy if (name, module) not in TOP_LEVEL_EXCEPTIONS}


@pytest.mark.parametrize("path", MODULES, ids=IDS)
def test_module_is_short_and_says_what_it_is(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= MAX_LINES
    assert ast.get_docstring(ast.parse(text)), "a module docstring is expected"
    assert path.stem not in {"utils", "helpers", "common", "misc"}


def module_name(path: Path) -> str:
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def arrows() -> dict[str, set[str]]:
    """Return, for each module, the modules that it imports anywhere, including imports inside functions and
    for annotations alone."""
    modules = {module_name(path): path for path in MODULES}
    graph = {}
    for name, path in modules.items():
        wanted = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                whole = {f"{node.module}.{alias.name}" for alias in node.names}
                wanted |= (whole & set(modules)) or {node.module}
        graph[name] = (wanted & set(modules)) - {name}
    return graph


DEPTHS = range(1, 1 + max(len(path.relative_to(REPOSITORY).parts) for path in MODULES))


@pytest.mark.parametrize("depth", DEPTHS)
def test_imports_have_no_circle(depth: int) -> None:
    """The modules and subfolders of one folder do not import each other in a circle. Names are cut to their
    first `depth` parts, so that a subfolder counts as a whole: the packages are compared at depth 1, what is
    directly in a package at depth 2, and single modules at the largest depth. A module counts on its own
    beside a subfolder of its folder, which may import some of these modules and be imported by others."""
    imports = arrows()
    assert sum(map(len, imports.values())) > 80
    graph: dict[str, set[str]] = {}
    for module, wanted in imports.items():
        name, *others = (".".join(each.split(".")[:depth]) for each in (module, *wanted))
        graph.setdefault(name, set()).update(set(others) - {name})
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_a_folder_can_be_looked_through() -> None:
    """A folder has at most 15 modules, not counting `__init__.py`, and at most 9 subfolders with modules. A
    folder of the page has at most 15 files."""
    for folder in {
        path.parent for package in (*PACKAGES, "tests") for path in (REPOSITORY / package).rglob("*.py")
    }:
        modules = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
        rooms = [path for path in folder.iterdir() if path.is_dir() and any(path.rglob("*.py"))]
        assert len(modules) <= 15 and len(rooms) <= 9, folder
    for folder in {path.parent for path in (REPOSITORY / "player/page/web").rglob("*") if path.is_file()}:
        assert len([path for path in folder.iterdir() if path.is_file()]) <= 15, folder


STARTERS = re.compile(
    r"sys\.(executable|path)\b|\bmultiprocessing\b|ProcessPoolExecutor|DataLoader|LocalCluster|\bdistributed\.Nanny"
    r"|os\.(system|popen|exec\w+|spawn\w+|posix_spawn\w*)\b|mp\.spawn"
)
"""Pattern of code that starts an interpreter or decides in which folders it looks for modules."""
SUBPROCESSES = {
    "player/proof.py",
    "exporters/mesh/unwrap.py",
    "vfr_bake/bench/process.py",
    "vfr_bake/demo.py",
}


@pytest.mark.parametrize("path", [*MODULES, *sorted((REPOSITORY / "examples").glob("*.py"))], ids=str)
def test_interpreters_are_started_by_one_function(path: Path) -> None:
    """Only `player/child.py` starts interpreters; others would look for modules in the current folder."""
    name = path.relative_to(REPOSITORY).as_posix()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):  # docstrings may name what the code must not use
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module) and ast.get_docstring(node):
            node.body[0] = ast.Pass()
    found = {match[0] for match in STARTERS.finditer(ast.unparse(tree))}
    assert not found or name == "player/child.py", found
    assert ("subprocess" in set(imported(tree, top_level=False))) == (name in SUBPROCESSES)
    assert name not in SUBPROCESSES or "python_command(" in ast.unparse(tree)


def test_there_are_modules() -> None:
    assert all(any(name.startswith(package) for name in IDS) for package in PACKAGES)


@pytest.mark.parametrize(
    "missing",
    [
        ["torch"],
        [
            *("torch", "numba", "scipy", "skimage", "onnx", "cv2", "tqdm", "tyro", "OpenEXR", "open3d"),
            *("viser", "av", "distributed", "PIL", "pxr", "xatlas"),
        ],
    ],
)
def test_player_and_exporters_start_without(missing: list[str]) -> None:
    program = (
        f"import sys; sys.modules.update(dict.fromkeys({missing!r})); "
        "import player.app.cli, player.app.play, player.app.cluster, player.app.info; "
        "import player.viewer.server, player.terminal; "
        "import exporters.cli, exporters.export, exporters.export_mesh, exporters.pictures; "
        "from exporters.formats import colmap, exr, glb, npz, obj, parity, ply, usd, vdb; "
        "from exporters.head import asset_head, onnx_head; "
        "from exporters.mesh import simplify, unwrap; from exporters.surface import components, tsdf; "
        "print('torch' in sys.modules and sys.modules['torch'])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "None"


def test_pyproject_lists_every_package() -> None:
    """The packages in pyproject.toml are all the folders with modules. The file is read as text, because
    Python 3.10 has no TOML parser."""
    text = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    block = re.search(r"^packages = \[(.*?)\]", text, re.DOTALL | re.MULTILINE)
    assert block, "[tool.setuptools] packages is expected"
    listed = re.findall(r'"([\w.]+)"', block[1])
    folders = {".".join(path.parent.relative_to(REPOSITORY).parts) for path in MODULES}
    assert sorted(listed) == sorted(folders)
    assert all((REPOSITORY / name.replace(".", "/") / "__init__.py").is_file() for name in listed)
    assert all((REPOSITORY / package / "py.typed").is_file() for package in PACKAGES)


def test_constraints_pin_exactly_and_cover_every_dependency() -> None:
    pins = set()
    for line in (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            match = re.fullmatch(r"([\w.-]+)==[\w.]+(; python_version (<|>=) \"3\.11\")?", line)
            assert match, f"constraints.txt: expected name==version, got {line!r}"
            pins.add(re.sub(r"[-_.]+", "-", match[1]).lower())
    text = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    wanted = set(
        re.findall(r'^\s*(?:(?!requires)\w+ = \[)?"([A-Za-z][\w-]*)(?:\[\w+\])?>=', text, re.MULTILINE)
    )
    assert len(wanted) > 16
    assert not {name.lower() for name in wanted} - pins


@pytest.mark.parametrize(
    ("system", "machine", "python", "wheels"),
    [
        ("linux", "x86_64", "3.10", {"numba", "usd-core", "xatlas", "open3d-cpu", "pycolmap"}),
        ("linux", "aarch64", "3.10", {"numba", "open3d"}),
        ("linux", "aarch64", "3.11", {"numba", "usd-core", "open3d"}),
        ("darwin", "arm64", "3.10", {"numba", "usd-core", "xatlas", "open3d", "pycolmap"}),
        ("darwin", "x86_64", "3.10", {"numba", "usd-core", "xatlas"}),
        ("win32", "AMD64", "3.10", {"numba", "usd-core", "xatlas", "open3d", "pycolmap"}),
    ],
)
def test_a_system_gets_the_packages_that_have_a_wheel_for_it(
    system: str, machine: str, python: str, wheels: set[str]
) -> None:
    """The requirements with a marker that hold on a system are the packages that PyPI has wheels of there."""
    text = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    requirements = [Requirement(line) for line in re.findall(r'^ +"([^"]+;[^"]+)"', text, re.MULTILINE)]
    here = {"sys_platform": system, "platform_machine": machine, "python_version": python}
    names = [each.name for each in requirements if each.marker and each.marker.evaluate(here)]
    assert sorted(names) == sorted(wheels)


def test_one_file_alone_names_instructions_of_one_processor() -> None:
    """Only one file uses instructions of one kind of processor. All other code that is written for LLVM,
    kernels for training included, compiles for any processor, so that LLVM never ends the process over it."""
    named = [
        path.relative_to(REPOSITORY).as_posix()
        for package in ("player", "exporters", "vfr_bake")
        for path in (REPOSITORY / package).rglob("*.py")
        if re.search(r"llvm\.(x86|aarch64|arm|nvvm)|InlineAsm|inline_asm", path.read_text(encoding="utf-8"))
    ]
    assert named == ["player/head/dense_tiles.py"]


BESIDE_THE_WAY = {"player/asset/asset.py", "player/cameras/camera.py"}
"""Files whose functions the way of a ray asks for numbers alone: those of the asset and of the camera."""


def called_files(asset: Asset) -> set[str]:
    """Return the player's files whose functions run while a picture is rendered by numpy."""
    called: set[str] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(REPOSITORY / "player"):
            called.add(path.relative_to(REPOSITORY).as_posix())

    before = sys.getprofile()
    threading.setprofile(note)  # for the renderer's threads, which begin with its first picture
    try:
        with Renderer(asset, 1, "numpy") as renderer:
            camera = asset_cameras(asset)[0].resized(8, 8)
            assert renderer.render(camera).opacity.max() > 0.5  # and fills the caches
            called.clear()
            sys.setprofile(note)
            renderer.render(camera)
    finally:
        sys.setprofile(before)
        threading.setprofile(before)
    return called


@pytest.mark.parametrize("contracted", [False, True])
def test_the_way_of_a_ray_takes_ten_files_which_are_those_of_the_manual(
    contracted: bool, shells_folder: Path
) -> None:
    asset = Asset.open(shells_folder)
    if contracted:
        space = ((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
        asset = replace(asset, manifest=replace(asset.manifest, contracted=True, aabb=space))
    text = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
    way = text.split("## The way of one ray\n")[1].split("\n##")[0]
    named = re.findall(r"\]\(\.\./(player/[^)]+)\)", way)
    assert len(named) == len(set(named)), "a file is linked to twice"
    of_a_box = {"player/march/bounds.py", "player/march/box.py"}
    of_space = {"player/march/contracted.py", "player/march/contraction.py"}
    taken = set(named) - (of_a_box if contracted else of_space)
    assert len(taken) == len(re.findall(r"^\d+\. ", way, re.MULTILINE)) == 10
    assert called_files(asset) - BESIDE_THE_WAY == taken
