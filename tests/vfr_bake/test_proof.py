"""A bake tests compiled code on this processor before it begins, and uses numpy if results are wrong."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from player.asset.asset import Asset
from player.march import march
from tests.player.march.test_march import random_rays
from tests.player.test_proof import DIES, WRONG, child_runs, lines, nothing_known
from vfr_bake.baking import bake, plan
from vfr_bake.baking.held_out import HeldOut
from vfr_bake.commands.bake import bake_command
from vfr_bake.config import BakeConfig, FieldConfig
from vfr_bake.training import model_file

__all__ = ["nothing_known"]


def test_a_bake_asks_before_it_begins(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    made = SimpleNamespace(n_bytes=1, resolutions=(1, 1), n_cells=1, n_rays=lambda n: n)
    child_runs(monkeypatch, DIES)
    model = SimpleNamespace(field=SimpleNamespace(config=FieldConfig()))
    monkeypatch.setattr(model_file, "load_model", lambda *_: model)
    monkeypatch.setattr(plan, "check_bakeable", lambda *_: None)
    monkeypatch.setattr(plan, "make_plan", lambda *_: made)
    monkeypatch.setattr(plan, "expected_seconds", lambda *_: 1.0)
    monkeypatch.setattr(bake, "bake", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    options = SimpleNamespace(
        asset=tmp_path / "asset",
        model=None,
        config=BakeConfig(),
        force=False,
        json=None,
        convert=None,
    )
    with pytest.raises(KeyboardInterrupt):
        bake_command(options)
    assert "vfr-bake: compiled code does not run on this processor (SIGABRT)" in capfd.readouterr().err


def test_a_bake_measures_with_numpy_where_compiled_code_is_wrong(
    monkeypatch: pytest.MonkeyPatch, shells_folder: Path
) -> None:
    child_runs(monkeypatch, WRONG)
    assert len(lines()) == 1
    views = object.__new__(HeldOut)
    views.rays_o, views.rays_d = random_rays(20)
    grid = Asset.open(shells_folder).grid
    np.testing.assert_array_equal(
        views.march(grid, 3).features, march.march(grid, views.rays_o, views.rays_d, 3).features
    )
