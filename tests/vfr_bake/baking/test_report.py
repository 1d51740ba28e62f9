"""The report as a page and as JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from player.asset.asset import read_manifest
from player.asset.manifest import file_entry, manifest_bytes
from vfr_bake.baking.bake import bake
from vfr_bake.baking.held_out import HeldOut, expected_loss
from vfr_bake.baking.mesh import LISTED_BYTES
from vfr_bake.baking.report import BakeReport, Pictures, bars
from vfr_bake.config import BakeConfig
from vfr_bake.training.model_file import Model

STAGE = {"psnr": 40.0, "loss_db": 0.5, "loss_db_spread": 0.03, "samples_median": 5.0, "samples_p95": 9.0}


def report(**changes: object) -> BakeReport:
    parts = {
        "title": "a <scene> & more",
        "asked": {"preset": "fast"},
        "stages": [{"name": "grid", **STAGE}, {"name": "files", **STAGE, "loss_db": 0.25}],
        "measured_on": "Measured on <7> pixels.",
        "n_bytes": {"features.codes": 2_000_000},
        "seconds": {"grid": 1.5},
        "left_out": {"head": "256 wide, this one is <64>"},
        "lookups": {"1": 0.5, "2": 0.125},
        "parts": [{"bytes": 1000, "loss_db": 6.25}],
        "missed": [],
        "gpu_bytes": 40_000_000,
        "pictures": [Pictures("view", np.zeros((8, 9, 3)), np.ones((8, 9, 3)))],
    }
    return BakeReport(**(parts | changes))  # type: ignore[arg-type]


class Tags(HTMLParser):
    """Parser that counts tags, and fails at the end of a tag that is not open."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in {"meta", "img", "br"} and not tag == "rect":
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_the_page_is_whole_and_escapes_what_it_is_given() -> None:
    page = report(missed=["size: <1 MB"]).html().decode()
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    text = " ".join(tags.texts)
    for said in ("a <scene> & more", "size: <1 MB", "this one is <64>", "0.250 dB", "2.00 MB", "0.125 dB"):
        assert said in text, said
    for said in ("a loss of 0.25 dB (give or take 0.03 dB)", "Measured on <7> pixels.", "0.030"):
        assert said in text, said
    assert "expected loss" not in text
    assert "Missed" not in report().html().decode()


def test_a_name_that_is_no_text() -> None:
    """A folder's name that is not UTF-8, as Linux allows, is shown with question marks."""
    assert "<h1>b?ke</h1>" in report(title="b\udce4ke").html().decode()


def test_the_json_says_the_same() -> None:
    said = json.loads(report().json())
    assert [stage["name"] for stage in said["stages"]] == ["grid", "files"]
    assert said["bytes"] == {"features.codes": 2_000_000} and said["missed"] == []
    assert (said["loss_db"], said["loss_db_spread"]) == (0.25, 0.03)
    assert said["measured_on"] == "Measured on <7> pixels."
    with pytest.raises(ValueError, match="not JSON compliant"):
        report(seconds={"grid": float("nan")}).json()


def test_the_manifest_is_counted_as_it_lists_the_report(shells_folder: Path) -> None:
    manifest = read_manifest(shells_folder)
    before = len(manifest_bytes(manifest))
    made = report(n_bytes={"manifest.json": before})
    files = made.with_files(manifest, b"a mesh")
    listed = manifest.files | {name: file_entry(data) for name, data in files.items()}
    size = len(manifest_bytes(replace(manifest, files=listed)))
    assert json.loads(files["report.json"])["bytes"] == made.n_bytes == {"manifest.json": size}
    assert 200 < size - before < LISTED_BYTES, "the bytes that a mesh leaves for it"


def test_a_loss_that_is_not_measured_is_called_expected() -> None:
    estimated = report(stages=[{"name": "files", **STAGE, "loss_db_spread": None}])
    page = estimated.html().decode()
    assert "an expected loss of 0.50 dB against" in page and "expected loss, dB" in page
    assert json.loads(estimated.json())["loss_db_spread"] is None


def test_bars_of_nothing_and_of_zeros() -> None:
    assert "<rect" not in bars({}, "dB", 1)
    assert 'width="0.0"' in bars({"grid": 0.0}, "dB", 1)


def test_expected_loss_is_that_of_independent_errors() -> None:
    random = np.random.default_rng(0)
    of_model, of_bake = random.normal(0, 0.02, (2, 1_000_000)) * np.array([[1.0], [0.3]])
    alone, both = (-10 * np.log10(np.mean(e**2)) for e in (of_model, of_model + of_bake))
    assert expected_loss(float(np.mean(of_bake**2)), float(alone)) == pytest.approx(alone - both, abs=0.01)
    assert expected_loss(0.0, 30.0) == 0


def test_the_bake_measures_what_its_first_parts_show(model: Model, tmp_path: Path) -> None:
    settings = BakeConfig(preset="fast", resolution=144, mesh_resolution=32, refine_steps=0, check_views=1)
    result = bake(model, tmp_path / "asset", settings, lambda *_: None)
    parts = json.loads((tmp_path / "asset" / "report.json").read_text())["parts"]
    manifest = read_manifest(tmp_path / "asset")
    assert manifest.provenance["baked"]["parts"] == parts == result.figures["parts"]
    assert [part["bytes"] for part in parts] == [part.bytes for part in manifest.parts[:-1]]
    assert parts and parts[0]["loss_db"] > 1
    held_out = HeldOut(model, 1)
    assert len(held_out.first_parts(tmp_path / "asset", 1, 4.0)) == len(parts)
    assert held_out.first_parts(tmp_path / "asset", 1, 1e-4) == [], "parts that take more memory are left out"
