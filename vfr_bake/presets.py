"""Presets of `vfr-bake`: the settings that each of them chooses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Preset = Literal["fidelity", "balanced", "fast", "phone"]


@dataclass(frozen=True, kw_only=True)
class BakeChoice:
    """Settings that a preset chooses; those that the user gives replace them."""

    preset: Preset
    cells_per_pixel: float
    """Resolution of the densities if none is given: cells for each pixel that the training pictures have
    across the middle of the box; at most one and a half times the field's finest level."""
    contracted_resolution: int
    """Resolution of the densities of an unbounded scene if none is given: cells along an axis of contracted
    space, which is four model units wide; few of the cells hold anything."""
    feature_share: float
    """Resolution of the features, as a share of that of the densities; at most the field's finest level."""
    culled_loss_db: float
    """Largest loss in dB for which an object's cells are left out before refinement; the loss from that
    alone."""
    detail_loss_db: float
    """Largest loss in dB for which detail is dropped after refinement, unless less loss was asked for."""
    n_channels: int
    """Largest number of feature channels."""
    channel_loss_db: float
    """Largest loss in dB, before refinement, for which fewer channels are stored."""
    n_fetches: int
    """Largest number of feature lookups per ray, k; 0 for every sample."""
    sample_loss_db: float
    """Largest loss in dB for which fewer lookups are taken."""
    code_loss_db: float
    """Approximate loss in dB on training pixels from the choice of stored values, beside what rounding to
    whole codes loses: the more, the fewer bytes."""
    density_step: int
    """Quantization step of the densities: difference between neighbouring codes that are stored, of 0 to
    255."""
    code_levels: int
    """Largest feature code, 7 to 127."""
    head_width: int
    """Width of a smaller head; 0 keeps the model's own."""
    head_layers: int
    """Directional layers of a smaller head after the first."""
    head_bands: int
    """Bands of spherical harmonics of a smaller head, at most the model's; with 1, nothing depends on the
    direction."""
    head_bits: int
    """Bits of the head's wide layers, 8 or 32."""
    refine_steps: int
    """Most steps of refinement before the lookups and bits are chosen that are played; two thirds as many as
    are taken follow with these."""
    minutes: float = 8
    """Wall-clock minutes of a bake, roughly: refinement takes fewer steps if the machine is too slow for all
    of them, unless their number was asked for."""
    mesh_resolution: int
    """Sets the number of the mesh's faces: as many as a grid of this many voxels along the box would give it;
    0: as many as its bytes allow."""
    target_loss_db: float
    """Loss in dB that the preset aims at."""
    page_mb: float
    """Graphics memory in MB, roughly, that the grids may take in a page before any detail is dropped: they
    are as fine as fits, unless their resolution was given. With the phone preset it is more than PAGE_MB,
    because more than half of the features' detail is dropped afterwards."""


PRESETS: dict[Preset, BakeChoice] = {
    "fidelity": BakeChoice(
        preset="fidelity",
        cells_per_pixel=1.95, contracted_resolution=1536, feature_share=0.68, culled_loss_db=0.01,
        detail_loss_db=0.02, n_channels=22, channel_loss_db=0.03, n_fetches=16, sample_loss_db=0.005,
        code_loss_db=0.02, density_step=2, code_levels=127, head_width=0, head_layers=3,
        head_bands=4, head_bits=8, refine_steps=1200, mesh_resolution=128, target_loss_db=0.05,
        page_mb=1024,
    ),
    "balanced": BakeChoice(
        preset="balanced",
        cells_per_pixel=1.65, contracted_resolution=1408, feature_share=0.775, culled_loss_db=0.02,
        detail_loss_db=0.06, n_channels=16, channel_loss_db=0.15, n_fetches=12, sample_loss_db=0.05,
        code_loss_db=0.13, density_step=4, code_levels=50, head_width=64, head_layers=3,
        head_bands=4, head_bits=8, refine_steps=3000, mesh_resolution=128, target_loss_db=0.4,
        page_mb=512,
    ),
    "fast": BakeChoice(
        preset="fast",
        cells_per_pixel=1.55, contracted_resolution=640, feature_share=0.68, culled_loss_db=0.05,
        detail_loss_db=0.1, n_channels=16, channel_loss_db=0.25, n_fetches=12, sample_loss_db=0.1,
        code_loss_db=0.67, density_step=6, code_levels=50, head_width=48, head_layers=1,
        head_bands=3, head_bits=8, refine_steps=3600, mesh_resolution=48, target_loss_db=1.0,
        page_mb=512,
    ),
    "phone": BakeChoice(
        preset="phone",
        cells_per_pixel=1.45, contracted_resolution=1280, feature_share=0.68, culled_loss_db=0.05,
        detail_loss_db=0.1, n_channels=16, channel_loss_db=0.25, n_fetches=8, sample_loss_db=0.3,
        code_loss_db=0.4, density_step=6, code_levels=50, head_width=32, head_layers=1,
        head_bands=3, head_bits=8, refine_steps=3000, mesh_resolution=48, target_loss_db=1.5,
        page_mb=384,
    ),
}  # fmt: skip

PAGE_MB: dict[Preset, int] = {"fidelity": 1024, "balanced": 512, "fast": 512, "phone": 256}
"""Graphics memory in MB that a page of the finished asset should take at most."""

UNBOUNDED: dict[Preset, dict[str, Any]] = {
    "fidelity": {"refine_steps": 400, "feature_share": 1.0, "n_channels": 24},
    "balanced": {
        "refine_steps": 2600,
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
        "refine_steps": 1500,
        "feature_share": 0.58,
        "n_channels": 12,
        "channel_loss_db": 0.5,
        "sample_loss_db": 0.15,
        "code_loss_db": 0.1,
    },
    "phone": {"refine_steps": 1500, "feature_share": 1.0, "channel_loss_db": 0.5, "code_loss_db": 0.15},
}
"""Settings that the presets choose differently for an unbounded scene. Its rays have several times as many
fetches, which take more time; and most of the loss comes from the features, because the grid has so few
cells."""
