"""USD: the mesh for film, Omniverse, Unreal and Blender, as .usdc (binary) or .usda (text).

The file is written by Pixar's own library (the package usd-core). Its stage states what glTF and
OBJ leave to convention: `upAxis` and `metersPerUnit = 1` (a world unit is taken as a metre, as in
glTF). `primvars:displayColor` is LINEAR light by the specification; `displayOpacity` is there only
if some vertex is not opaque.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from exporters.extras import needs
from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.mesh import TriangleMesh
from player.errors import ConfigError, FormatError


def usd_bytes(mesh: TriangleMesh, suffix: str, up: str) -> bytes:
    """Return the file's content; the same mesh gives the same bytes.

    Args:
        mesh: at least one face, in the coordinates of the file.
        suffix: ".usdc" or ".usda".
        up: "Y" or "Z", the axis that is up in those coordinates.

    Raises:
        ConfigError: the mesh has no face.
        MissingExtraError: the package `usd-core` is not installed.
    """
    if not len(mesh.faces):
        raise ConfigError("USD: mesh: expected at least one face, got none")
    Usd, UsdGeom, Vt = load_usd()
    colours = linear_from_srgb(mesh.colours[:, :3] / 255).astype(np.float32)
    vertices = mesh.vertices.astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / f"mesh{suffix}")
        stage = Usd.Stage.CreateNew(path)
        stage.SetMetadata("comment", "vfr-bake: a world unit is a metre; displayColor is linear light")
        UsdGeom.SetStageUpAxis(stage, up)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/scene")
        stage.SetDefaultPrim(root.GetPrim())
        prim = UsdGeom.Mesh.Define(stage, "/scene/mesh")
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(mesh.faces), 3))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.reshape(-1)))
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(mesh.normals.astype(np.float32)))
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
        prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(colours))
        if (mesh.colours[:, 3] < 255).any():
            opacity = (mesh.colours[:, 3] / 255).astype(np.float32)
            prim.CreateDisplayOpacityPrimvar(UsdGeom.Tokens.vertex).Set(Vt.FloatArray.FromNumpy(opacity))
        stage.GetRootLayer().Save()
        del prim, root, stage  # closes the file before its folder is deleted, as Windows requires
        return Path(path).read_bytes()


def parse_usd(data: bytes, suffix: str, where: str) -> dict[str, Any]:
    """Return the arrays of a file, read by the library: `vertices`, `normals` [n, 3], `colours` [n, 4] linear
    and `faces` [m, 3], and also `up` ("Y" or "Z") and `metres` (per unit). Raises FormatError for a file
    without triangles or of another format."""
    Usd, UsdGeom, _ = load_usd()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh{suffix}"
        path.write_bytes(data)
        try:
            stage = Usd.Stage.Open(str(path))
        except Exception as error:  # the library raises one exception for everything
            raise FormatError(f"{where}: expected USD, got: {str(error).splitlines()[0]}") from error
        prim = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh"))
        if not prim or set(prim.GetFaceVertexCountsAttr().Get()) != {3}:
            raise FormatError(f"{where}: expected triangles in /scene/mesh, got none")
        opacity = prim.GetDisplayOpacityAttr().Get()
        rgb = np.array(prim.GetDisplayColorAttr().Get())
        alpha = np.ones(len(rgb)) if opacity is None else np.array(opacity)
        found = {
            "vertices": np.array(prim.GetPointsAttr().Get()),
            "normals": np.array(prim.GetNormalsAttr().Get()),
            "colours": np.concatenate([rgb, alpha[:, None]], axis=1),
            "faces": np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3),
            "up": str(UsdGeom.GetStageUpAxis(stage)),
            "metres": UsdGeom.GetStageMetersPerUnit(stage),
        }
        del prim, stage
    return found


def load_usd() -> tuple[Any, Any, Any]:
    """Import Usd, UsdGeom and Vt of the package usd-core, or raise MissingExtraError, which says how to
    install it. It is also called before long work."""
    with needs("USD", "usd-core"):
        from pxr import Usd, UsdGeom, Vt
    return Usd, UsdGeom, Vt
