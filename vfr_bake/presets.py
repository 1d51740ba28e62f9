"""What the presets of `vfr-bake` decide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Preset = Literal["fidelity", "balanced", "fast", "phone"]


@dataclass(frozen=True, kw_only=True)
class BakeChoice:
    """What a preset decides; settings that were given replace it."""

    cells_per_pixel: float
    """Resolution of the densities where none is given: cells for each pixel that the training pictures see
    across the middle of the box, at most half again the field's finest level."""
    contracted_resolution: int
    """Resolution of the densities of an unbounded scene where none is given: cells along an axis of
    contracted space, which is four model units wide; few of the cells hold anything."""
    feature_share: float
    """Cells of the features' grid for a cell of the densities', along an axis; at most the field's finest
    level."""
    culled_loss_db: float
    """Cells are left out where leaving them out, alone, loses no more than this, dB."""
    n_channels: int
    """Largest number of feature channels."""
    channel_loss_db: float
    """Fewer channels are taken where they lose no more than this, before refinement, dB."""
    n_fetches: int
    """Largest number of feature lookups per ray, k; 0 for every sample."""
    sample_loss_db: float
    """Fewer lookups are taken where they lose no more than this, dB."""
    code_loss_db: float
    """Stored values are chosen that lose about this by themselves, dB: the more, the fewer bytes."""
    density_step: int
    """Density codes, of 256, from one that is stored to the next."""
    code_levels: int
    """Largest feature code, 7 to 127."""
    head_width: int
    """Width of a smaller head; 0 keeps the model's own."""
    head_layers: int
    """Directional layers of a smaller head after the first."""
    head_bands: int
    """Bands of spherical harmonics of a smaller head, at most the model's; 1 where nothing depends on the
    direction."""
    head_bits: int
    """Bits of the head's wide layers, 8 or 32."""
    refine_steps: int
    """Steps of each round of refinement."""
    minutes: float = 8
    """Wall-clock minutes of a bake, roughly: refinement takes fewer steps where the machine is too slow for
    all of them, unless their number was asked for."""
    mesh_resolution: int
    """The mesh gets the faces that a grid of so many voxels along the box would give it; 0: as many as its
    bytes allow."""
    target_loss_db: float
    """Loss that the preset aims at, dB."""
    page_mb: float
    """Graphics memory that a page of the grids may take before any detail is dropped, MB, roughly: they are
    as fine as fits, unless their resolution was given. The phone's pages are to take 256: more than half of
    its features' detail is dropped."""


PRESETS: dict[Preset, BakeChoice] = {
    "fidelity": BakeChoice(
        cells_per_pixel=1.95, contracted_resolution=1536, feature_share=0.68, culled_loss_db=0.02,
        n_channels=22, channel_loss_db=0.03, n_fetches=16, sample_loss_db=0.005,
        code_loss_db=0.01, density_step=2, code_levels=127, head_width=0, head_layers=3,
        head_bands=4, head_bits=8, refine_steps=1600, mesh_resolution=128, target_loss_db=0.05,
        page_mb=1024,
    ),
    "balanced": BakeChoice(
        cells_per_pixel=1.65, contracted_resolution=1408, feature_share=0.775, culled_loss_db=0.06,
        n_channels=16, channel_loss_db=0.15, n_fetches=12, sample_loss_db=0.05,
        code_loss_db=0.03, density_step=4, code_levels=50, head_width=64, head_layers=3,
        head_bands=4, head_bits=8, refine_steps=3600, mesh_resolution=128, target_loss_db=0.4,
        page_mb=512,
    ),
    "fast": BakeChoice(
        cells_per_pixel=1.55, contracted_resolution=640, feature_share=0.68, culled_loss_db=0.1,
        n_channels=16, channel_loss_db=0.25, n_fetches=12, sample_loss_db=0.1,
        code_loss_db=0.26, density_step=6, code_levels=50, head_width=48, head_layers=1,
        head_bands=3, head_bits=8, refine_steps=4000, mesh_resolution=48, target_loss_db=1.0,
        page_mb=512,
    ),
    "phone": BakeChoice(
        cells_per_pixel=1.45, contracted_resolution=1280, feature_share=0.68, culled_loss_db=0.1,
        n_channels=16, channel_loss_db=0.25, n_fetches=8, sample_loss_db=0.3,
        code_loss_db=0.2, density_step=6, code_levels=50, head_width=32, head_layers=1,
        head_bands=3, head_bits=8, refine_steps=3000, mesh_resolution=48, target_loss_db=1.5,
        page_mb=384,
    ),
}  # fmt: skip

UNBOUNDED: dict[Preset, dict[str, Any]] = {
    "fidelity": {"refine_steps": 400, "feature_share": 1.0, "n_channels": 24},
    "balanced": {
        "refine_steps": 2100,
        "minutes": 10,
        "feature_share": 1.0,
        "n_channels": 24,
        "channel_loss_db": 0.03,
        "sample_loss_db": 0.02,
        "code_loss_db": 0.03,
        "code_levels": 64,
        "head_bands": 5,
        "target_loss_db": 0.5,
    },
    "fast": {
        "refine_steps": 1200,
        "feature_share": 0.58,
        "n_channels": 12,
        "channel_loss_db": 0.5,
        "sample_loss_db": 0.15,
        "code_loss_db": 0.1,
    },
    "phone": {"refine_steps": 1200, "feature_share": 1.0, "channel_loss_db": 0.5, "code_loss_db": 0.15},
}
"""What the presets decide differently for an unbounded scene: its rays have several times as many fetches,
which take their time; its features are most of what a grid of so few cells loses."""
