"""Presets: the table in docs/bake.md agrees with them, and what they allow of loss and memory."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from player.asset.asset import Asset
from player.errors import FormatError
from vfr_bake.baking.limits import page_memory
from vfr_bake.presets import PRESETS, Preset

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "bake.md"


def rows() -> dict[str, list[str]]:
    """Return the cells of each preset's row."""
    text = DOCUMENT.read_text(encoding="utf-8").split("## What the presets decide\n\n")[1]
    table = text.split("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    return {name.split(" ")[0]: rest for name, *rest in cells}


def test_every_preset_has_a_row() -> None:
    assert list(rows()) == list(PRESETS)


@pytest.mark.parametrize("name", PRESETS)
def test_a_row_says_what_the_preset_decides(name: str) -> None:
    preset = PRESETS[name]  # type: ignore[index]
    *numbers, head, aim = rows()[name]
    told = (
        *(preset.cells_per_pixel, preset.feature_share),
        *(f"{preset.culled_loss_db} dB", f"{preset.detail_loss_db} dB"),
        *(preset.n_channels, preset.code_levels, preset.n_fetches),
    )
    assert numbers == [str(value) for value in told]
    assert aim == f"{preset.target_loss_db} dB"
    if preset.head_width == 0:
        assert head == "the model's own"
        return
    layers, width = map(int, re.findall(r"\d+", head)[:2])
    # A head also has two spatial layers and a first directional one, before the further directional layers.
    assert (layers, width) == (3 + preset.head_layers, preset.head_width)
    harmonics = re.search(r"(\d+) spherical harmonics", head)
    assert (int(harmonics[1]) if harmonics else 16) == preset.head_bands**2


def test_a_page_of_more_memory_than_the_preset_aims_at_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    asset: Any = None
    bounds: dict[Preset, int] = {"phone": 256, "balanced": 512, "fidelity": 1024}
    for preset, most in bounds.items():
        monkeypatch.setattr("vfr_bake.baking.limits.gpu_bytes", lambda asset, most=most: most * 10**6)
        assert page_memory(asset, preset) == (most * 10**6, [])
        monkeypatch.setattr("vfr_bake.baking.limits.gpu_bytes", lambda asset, most=most: most * 10**6 + 1)
        _, (missed,) = page_memory(asset, preset)
        assert missed.startswith(f"preset {preset}: expected a page that takes at most {most} MB of graphics")
        assert missed.endswith(f"lower --resolution, or export with --max-gpu-mb {most + 1}")

    def too_large(asset: Asset) -> int:
        raise FormatError("graphics memory: expected at most 8 bricks, got 9")

    monkeypatch.setattr("vfr_bake.baking.limits.gpu_bytes", too_large)
    none, (missed,) = page_memory(asset, "phone")
    assert none is None and "at most 8 bricks, got 9: lower --resolution" in missed
