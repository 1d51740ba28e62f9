"""Texture layout of a mesh by xatlas: the mesh is cut into charts, which are packed into a square.

xatlas cannot be stopped and reports no progress, so it runs in a process of its own, which is killed when the
time limit is over or on Ctrl-C. Its time grows faster than the number of faces that it is given at once
(1,500 faces: a tenth of a millisecond each; 6,000: over three), so the mesh is cut into small parts.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from exporters.shapes.mesh import TriangleMesh, crossed_edges
from player.child import python_command
from player.errors import ConfigError, DataError, MissingExtraError
from player.progress import Progress, silent

GUTTER = 2
"""Texels left free between two charts."""
EXTENT = 1000.0
"""Longest side of the mesh's box as xatlas is given it. xatlas leaves faces of up to 1.2e-7 square units out
of the layout; in a box of this size no face that matters is so small."""
PART = 1000
"""Largest number of faces in a part of the mesh; parts share no chart."""
# The charts together have the area of a square whose edge is this share of the picture's edge; xatlas packs
# charts so that they fill three quarters of the area.
_FILLED = 0.8
_POLL = 0.1  # seconds between two checks of the other process


def unwrap(
    mesh: TriangleMesh, size: int, seconds: float, progress: Progress = silent
) -> tuple[TriangleMesh, np.ndarray]:
    """Cut a mesh along seams, and place its vertices in a square picture.

    Args:
        mesh: any mesh with faces.
        size: texels along each side of the picture that the charts are packed for.
        seconds: time limit, after which the layout is given up.
        progress: called with the seconds passed and `seconds`, about every second.

    Returns:
        The mesh: the same faces in the same order, with vertices on seams once for each side. Its uvs
        [n_vertices, 2] float32, 0..1, with the origin at the upper left corner of the picture.

    Raises:
        ConfigError: the time limit is over.
        DataError: xatlas fails, or lays out other faces.
        MissingExtraError: xatlas is not installed.
    """
    require_xatlas()
    with tempfile.TemporaryDirectory(prefix="vfr-unwrap-") as name:
        folder = Path(name)
        low, high = mesh.bounds
        scale = EXTENT / max(float((high - low).max()), 1e-30)
        np.savez(
            folder / "mesh.npz",
            vertices=((mesh.vertices - low) * scale).astype(np.float32),
            faces=mesh.faces.astype(np.uint32),
            normals=mesh.normals.astype(np.float32),
            size=size,
        )
        _run(folder, seconds, len(mesh.faces), progress)
        with np.load(folder / "atlas.npz") as atlas:
            source, faces, uvs = atlas["source"].astype(np.int64), atlas["faces"], atlas["uvs"]
    if faces.shape != mesh.faces.shape or not np.array_equal(source[faces], mesh.faces):
        raise DataError(f"--texture: expected {len(mesh.faces)} faces laid out, got {len(faces)} or others")
    cut = TriangleMesh(
        mesh.vertices[source], faces.astype(np.int32), mesh.normals[source], mesh.colours[source]
    )
    return cut, np.clip(uvs, 0, 1).astype(np.float32)


def require_xatlas() -> None:
    """Raise MissingExtraError, which says how to install xatlas, if it is missing. It is also called before
    long work."""
    if importlib.util.find_spec("xatlas") is None:
        raise MissingExtraError("--texture: needs xatlas: pip install 'vfr-bake[export]'")


def _run(folder: Path, seconds: float, n_faces: int, progress: Progress) -> None:
    """Run the layout in another process, and wait until it has written atlas.npz into `folder`."""
    begin = time.monotonic()
    command = python_command("exporters.mesh.unwrap", str(folder))
    with (
        (folder / "errors").open("wb") as errors,
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=errors, stderr=errors) as process,
    ):
        try:
            shown = 0
            while process.poll() is None:
                passed = time.monotonic() - begin
                if passed > seconds:
                    raise ConfigError(
                        f"--texture: laying out {n_faces} faces: expected an end within {seconds:g} seconds, "
                        "got none: ask for fewer with --faces, or more time with --time-limit"
                    )
                if int(passed) > shown:
                    shown = int(passed)
                    progress(shown, max(int(seconds), shown + 1))
                time.sleep(_POLL)
        finally:
            process.kill()  # does nothing if it has ended
    if process.returncode:
        last = (folder / "errors").read_text(errors="replace").strip().splitlines() or ["no message"]
        raise DataError(
            f"--texture: xatlas: expected a layout, got exit code {process.returncode}: {last[-1]}"
        )


def parts_of(vertices: np.ndarray, faces: np.ndarray, largest: int) -> list[np.ndarray]:
    """Return face numbers in groups of at most `largest` faces that lie together: the faces are halved along
    the longest side, again and again.

    >>> corners = np.array([[float(x), 0, 0] for x in range(6)])
    >>> faces = np.array([[4, 5, 5], [0, 1, 1], [3, 4, 4], [1, 2, 2]])
    >>> [part.tolist() for part in parts_of(corners, faces, 2)]
    [[1, 3], [0, 2]]
    """
    centres = vertices[faces].mean(axis=1)
    open_, done = [np.arange(len(faces))], []
    while open_:
        part = open_.pop()
        if len(part) <= largest:
            done.append(np.sort(part))
            continue
        axis = int(np.ptp(centres[part], axis=0).argmax())
        order = part[np.argsort(centres[part, axis], kind="stable")]
        open_ += [order[len(order) // 2 :], order[: len(order) // 2]]
    return done


def _child(folder: str) -> None:
    """Lay out mesh.npz of `folder` and write atlas.npz there: the work of the other process."""
    import xatlas

    with np.load(Path(folder) / "mesh.npz") as mesh:
        vertices, faces, normals, size = (mesh[name] for name in ("vertices", "faces", "normals", "size"))
    area = float(np.linalg.norm(crossed_edges(vertices, faces), axis=-1).sum() / 2)
    parts = parts_of(vertices, faces, PART)
    atlas = xatlas.Atlas()
    used = []
    for part in parts:
        names, corners = np.unique(faces[part], return_inverse=True)
        atlas.add_mesh(vertices[names], corners.reshape(-1, 3).astype(np.uint32), normals[names])
        used.append(names)
    options = xatlas.PackOptions()
    options.texels_per_unit = _FILLED * float(size) / max(area, 1e-30) ** 0.5
    options.padding = GUTTER
    options.bilinear = True
    atlas.generate(xatlas.ChartOptions(), options)
    sources, places = [], []
    cut = np.zeros_like(faces)
    start = 0
    for number, (part, names) in enumerate(zip(parts, used, strict=True)):
        source, corners, uvs = atlas.get_mesh(number)
        cut[part] = corners + start
        sources.append(names[source])
        places.append(uvs)
        start += len(source)
    np.savez(
        Path(folder) / "atlas.npz", source=np.concatenate(sources), faces=cut, uvs=np.concatenate(places)
    )


if __name__ == "__main__":
    _child(sys.argv[1])
