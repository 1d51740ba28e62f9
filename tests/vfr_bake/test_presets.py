"""The table of presets in docs/bake.md agrees with the presets."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from vfr_bake.presets import PRESETS

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
        *(preset.cells_per_pixel, preset.feature_share, f"{preset.culled_loss_db} dB", preset.n_channels),
        *(preset.code_levels, preset.n_fetches),
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
