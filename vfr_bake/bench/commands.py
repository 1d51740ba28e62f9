"""The commands that bake an asset like a measured one, and that play it with a measured setting."""

from __future__ import annotations

from typing import Any

from player.asset.asset import Asset
from player.march.interpolation import Quality
from player.terminal import command_line
from vfr_bake.config import USUAL_MEMORY, BakeConfig
from vfr_bake.presets import PRESETS

GIVEN = (
    *("resolution", "feature_resolution", "weight_floor"),
    *("max_mb", "max_loss_db", "target_ms", "max_memory"),
)
"""Settings of `vfr-bake` that change the asset and that no preset decides."""
USUAL = {"max_memory": USUAL_MEMORY}
"""The values of those that an asset keeps, too, if they were not given."""


def bake_command(folder: str, asset: Asset) -> str:
    """Return the command that bakes an asset like this one, from the settings that the asset keeps; "" if it
    keeps none, or if they are not understood."""
    settings = asset.manifest.provenance.get("bake")
    preset = settings.get("preset") if isinstance(settings, dict) else None
    if not isinstance(settings, dict) or not isinstance(preset, str) or preset not in PRESETS:
        return ""
    chosen: dict[str, Any] = {
        name: settings[name] for name in GIVEN if settings.get(name) not in (None, USUAL.get(name))
    }
    usual = BakeConfig(preset=preset).choice(asset.manifest.contracted)
    for name in BakeConfig.__dataclass_fields__:
        if hasattr(usual, name) and settings.get(name, getattr(usual, name)) != getattr(usual, name):
            chosen[name] = settings[name]
    if settings.get("k", "auto") != "auto":
        chosen["k"] = settings["k"]
    if not all(value is None or isinstance(value, int | float) for value in chosen.values()):
        return ""
    options = [word for name, value in chosen.items() if value is not None
               for word in (f"--{name.replace('_', '-')}", _shown(value))]  # fmt: skip
    if settings.get("no_cull"):
        options.append("--no-cull")
    return command_line("vfr-bake", "model.pt", folder, "--preset", preset, *options)


def _shown(value: float) -> str:
    """Return a number as `vfr-bake` reads it, without a needless point.

    >>> _shown(1_000_000), _shown(50.0), _shown(0.00123456789)
    ('1000000', '50', '0.00123456789')
    """
    return str(value) if isinstance(value, int) else f"{value:.15g}"


def play_command(folder: str, samples: int, quality: Quality, size: tuple[int, int]) -> str:
    """Return the command that plays an asset with k = `samples`.

    >>> play_command("out", 5, "fast", (400, 300))
    'vfr-play out --samples 5 --quality fast --size 400x300 --orbit 60 --output frames/'
    """
    width, height = size
    dials = ["--samples", str(samples), *([] if quality == "exact" else ["--quality", quality])]
    views = ["--size", f"{width}x{height}", "--orbit", "60", "--output", "frames/"]
    return command_line("vfr-play", folder, *dials, *views)
