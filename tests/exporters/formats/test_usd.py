"""Tests of USD: what the stage states, that Pixar's library reads every number, and bounds in all frames."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom

from exporters import cli
from exporters.formats.axes import COORDINATES
from exporters.formats.parity import check_mesh_bytes
from exporters.formats.usd import parse_usd, usd_bytes
from exporters.shapes.colour import linear_from_srgb
from player.errors import ConfigError, FormatError, MissingExtraError, ParityError
from tests.exporters.formats.test_axes import expected_bounds
from tests.exporters.meshes import random_mesh, tetrahedron


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_every_number(suffix: str) -> None:
    mesh = random_mesh(300, 200)
    data = usd_bytes(mesh, suffix, "Z")
    assert data == usd_bytes(mesh, suffix, "Z")
    assert data.startswith(b"PXR-USDC" if suffix == ".usdc" else b"#usda 1.0")
    check_mesh_bytes(suffix, data, mesh, "a")
    found = parse_usd(data, suffix, "a")
    assert (found["up"], found["metres"]) == ("Z", 1.0)
    np.testing.assert_allclose(
        found["colours"][:, :3], linear_from_srgb(mesh.colours[:, :3] / 255), atol=6e-8
    )
    np.testing.assert_allclose(found["colours"][:, 3], mesh.colours[:, 3] / 255, atol=6e-8)
    wrong = mesh.colours.copy()
    wrong[7, 2] ^= 1
    with pytest.raises(ParityError, match="a: colours: number 7"):
        check_mesh_bytes(suffix, data, replace(mesh, colours=wrong), "a")


@pytest.mark.parametrize("suffix", ["usdc", "usda"])
@pytest.mark.parametrize("frame", COORDINATES)
def test_the_box_is_at_its_place(frame: str, suffix: str, shells_asset: Path, tmp_path: Path) -> None:
    """The library's bounds of the box are as expected in every frame, and the stage states its up axis."""
    path = tmp_path / f"box.{suffix}"
    assert cli.main([str(shells_asset), str(path), "--frame", frame, "--method", "baked"]) == 0
    stage = Usd.Stage.Open(str(path))
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    bounds: Gf.Range3d = cache.ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange()
    expected = expected_bounds("world" if frame == "blender" else frame, "usd")
    if frame == "gltf":
        expected = expected_bounds(frame, "glb")
    np.testing.assert_allclose([bounds.GetMin(), bounds.GetMax()], expected, atol=1e-6)
    assert UsdGeom.GetStageUpAxis(stage) == ("Y" if frame == "gltf" else "Z")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh"))
    assert UsdGeom.Mesh.ValidateTopology(
        mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), 8
    )[0]
    assert mesh.GetDisplayColorPrimvar().GetInterpolation() == "vertex"
    assert not mesh.GetDisplayOpacityAttr().HasValue(), "the box is opaque"


def test_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="USD: mesh: expected at least one face"):
        usd_bytes(replace(tetrahedron(), faces=np.zeros((0, 3), np.int32)), ".usdc", "Z")
    with pytest.raises(FormatError, match=r"a\.usdc: expected USD"):
        parse_usd(b"PXR-USDC", ".usdc", "a.usdc")
    with pytest.raises(FormatError, match=r"a\.usda: expected triangles"):
        parse_usd(b"#usda 1.0\n", ".usda", "a.usda")
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(MissingExtraError, match=r"needs usd-core: pip install 'vfr-bake\[export\]'"):
        usd_bytes(tetrahedron(), ".usdc", "Z")
