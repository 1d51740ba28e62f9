"""Descriptions of what each part of an asset adds, for `vfr-play --info`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate, groupby
from typing import Any

from player.asset.manifest import Manifest
from player.asset.sections import Part, Section


def parts_facts(manifest: Manifest) -> list[dict[str, Any]]:
    """Return the facts of each part: `file`, `bytes`, what it `adds`, `bytes_read` up to its end, head and
    cameras included, `share_read`, their share of all bytes but the reports', and `loss_db`, by how much the
    picture up to it is below the whole one; None if the bake has not recorded that for these parts."""
    files = {name: entry.bytes for name, entry in manifest.files.items() if not name.startswith("report.")}
    first = files.get("head.onnx", 0) + files.get("cameras.json", 0)
    read = list(accumulate((part.bytes for part in manifest.parts), initial=first))[1:]
    total = max(sum(files.values()), 1)
    rows = zip(manifest.parts, read, _losses(manifest), strict=True)
    return [
        {
            "file": part.file,
            "bytes": part.bytes,
            "adds": what_it_adds(part),
            "bytes_read": n_read,
            "share_read": n_read / total,
            "loss_db": loss,
        }
        for part, n_read, loss in rows
    ]


def _losses(manifest: Manifest) -> list[float | None]:
    """Return the losses that the bake recorded in the provenance, which may hold anything; they belong to
    other parts if the asset was written again."""
    baked = manifest.provenance.get("baked")
    found = baked.get("parts") if isinstance(baked, dict) else None
    found = [part for part in found if isinstance(part, dict)] if isinstance(found, list) else []
    losses = [part.get("loss_db") for part in found]
    whole = len(manifest.parts) == len(found) + 1 and all(
        part.bytes == one.get("bytes") for part, one in zip(manifest.parts, found, strict=False)
    )
    if not whole or not all(isinstance(loss, float) and math.isfinite(loss) for loss in losses):
        return [None] * len(manifest.parts)
    return [*losses, 0.0]


def what_it_adds(part: Part) -> str:
    """Describe the levels and channels that a part adds, the coarsest first.

    >>> of = {"grid": "features", "bytes": 9}
    >>> shapes = [Section(level=n, kind="structure", n_bricks=1, **of) for n in (2, 1, 0)]
    >>> symbols = [Section(level=n, kind="symbols", n_channels=4, **of) for n in (2, 1)]
    >>> what_it_adds(Part("part_0.bin", (*shapes, *symbols)))
    'features: channels 0 to 3 of levels 2 to 1; where level 0 is'
    """
    told = []
    for grid in ("densities", "features"):
        found = [section for section in part.sections if section.grid == grid]
        symbols = [section for section in found if section.kind == "symbols"]
        filled = {section.level for section in symbols}
        words = _of_features(symbols) if grid == "features" else [_levels(list(filled))] if filled else []
        bare = [s.level for s in found if s.kind == "structure" and s.level not in filled]
        if bare:
            words.append(f"where {_levels(bare)} {'is' if len(bare) == 1 else 'are'}")
        if words:
            told.append(f"{grid}: {'; '.join(words)}")
    return ". ".join(told)


def _of_features(symbols: Sequence[Section]) -> list[str]:
    """Describe levels and their channels; levels that get the same channels are joined."""
    channels: dict[int, tuple[int, int]] = {}
    for section in symbols:
        first, _ = channels.get(section.level, (section.first_channel, 0))
        channels[section.level] = (min(first, section.first_channel), section.end_channel - 1)
    rows = sorted(channels.items(), reverse=True)
    return [
        f"channel{'s' * (last > first)} {first}{f' to {last}' * (last > first)} of "
        f"{_levels([level for level, _ in some])}"
        for (first, last), some in groupby(rows, key=lambda row: row[1])
    ]


def _levels(levels: Sequence[int]) -> str:
    most, least = max(levels), min(levels)
    if len(set(levels)) < most - least + 1:
        return f"levels {', '.join(map(str, sorted(set(levels), reverse=True)))}"
    return f"level {least}" if most == least else f"levels {most} to {least}"
