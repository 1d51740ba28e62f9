"""Measurements of assets: the trade, qualities, exports, pages, lookups."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from tests.benchmarks.suite.scenes import Scene, data_of
from tests.benchmarks.suite.work import Usage, Work

LOOKUPS = ("1", "2", "3", "4", "5", "8", "12", "16", "32", "0")
TIMES = ("median", "uncertainty", "p95", "frames", "march", "lookups", "head")
"""Figures of a setting's times that are kept, in milliseconds a frame."""
EXPORTS: dict[str, tuple[str, int]] = {
    "scene.html": ("", 3),
    "mesh.glb": ("", 3),
    "baked.glb": ("--method baked", 3),
    "game.glb": ("--method density --faces 200000 --texture 2048", 1),
    "points.ply": ("--points 200000", 3),
    "scene.vdb": ("--colour", 1),
}
"""Files that are exported, with the options and the number of exports: one if it takes a minute or more."""


def trade(work: Work, scene: Scene, bakes: tuple[str, ...], samples: tuple[str, ...]) -> dict[str, Any]:
    """Run `vfr-bench` on some assets of a scene, with every number of lookups and every quality.

    `size` of the figures is the size of the frames by which settings are compared.
    """
    assets = [work.file(name, "asset") for name in bakes]
    model = work.file(f"train_{scene.name}", "model.pt")
    report = work.folder / "trade.json"
    work.command(
        "vfr-bench", *assets, "--data", data_of(work, scene), "--model", model, "--json", report,
        "--views", str(scene.views), "--frames", str(scene.frames), "--sizes", scene.size,
        "--samples", *samples, "--minutes", "120",
    )  # fmt: skip
    found = work.read("trade.json")
    names = {str(work.file(name, "asset")): name for name in bakes}
    rows = []
    for row in found["settings"]:
        times = {size: {key: some[key] for key in TIMES} for size, some in row["times"].items()}
        rows.append(
            {key: row[key] for key in ("n_fetches", "quality", "what", "n_bytes", "peak_mb")}
            | {"asset": names.get(row["asset"]), "first_picture_ms": row["first_picture_ms"]}
            | {"scores": {key: row["scores"][key] for key in ("psnr", "loss_db", "ssim", "psnr_to_model")}}
            | {"times": times}
        )
    kept = ("front_at", "threads", "march", "frames_a_setting_and_size")
    conditions = {key: found["conditions"][key] for key in kept}
    conditions["n_views"] = len(found["conditions"]["views"])
    own = "x".join(map(str, conditions["front_at"]))
    return {"settings": rows, "conditions": conditions, "size": own if work.quick else scene.size}


def qualities(work: Work, scene: Scene, asset_of: str) -> dict[str, Any]:
    """Measure both marches with every quality, frame by frame in turns."""
    size = work.little(scene.size, "24x24")
    frames = ("--frames", work.little(20, 2), "--numpy-frames", work.little(5, 2))
    words = ("--data", data_of(work, scene), "--views", str(scene.views), "--size", size, *frames)
    return _script(work, "bench_qualities", work.file(asset_of, "asset"), *words)


def exports(work: Work, asset_of: str) -> dict[str, Any]:
    """Export to files of each kind, in turns."""
    asset = work.file(asset_of, "asset")
    taken: dict[str, list[Usage]] = {file: [] for file in EXPORTS}
    for turn in range(int(work.little(3, 1))):
        for file, (options, turns) in EXPORTS.items():
            if turn < turns and not (work.quick and options):
                (work.folder / file).unlink(missing_ok=True)
                taken[file].append(work.command("vfr-export", asset, work.folder / file, *options.split()))
    return {
        file: {
            "options": EXPORTS[file][0],
            "n_bytes": (work.folder / file).stat().st_size,
            "seconds": of_runs([usage.seconds for usage in some]),
            "processor_seconds": of_runs([usage.processor_seconds for usage in some]),
            "peak_mb": max(usage.peak_mb for usage in some),
        }
        for file, some in taken.items()
        if some
    }


def page(work: Work, asset_of: str) -> dict[str, Any]:
    """Measure the page of an asset, in a browser that draws on the processor."""
    little = ("--size", work.little(400, 32), "--views", work.little(3, 1), "--rounds", work.little(3, 1))
    return _script(work, "bench_page", work.file(asset_of, "asset"), *little)


def viewers(work: Work, scene: Scene, asset_of: str) -> dict[str, Any]:
    """Measure Open3D, which draws an asset's exported mesh, and `vfr-play`, frame by frame in turns."""
    asset, mesh = work.file(asset_of, "asset"), work.folder / "mesh.ply"
    work.command("vfr-export", asset, mesh)
    little = ("--frames", work.little(20, 2), "--views", work.little(8, 1))
    words = ("--data", data_of(work, scene), "--size", work.little(scene.size, "24x24"), *little)
    return _script(work, "peers.open3d_mesh", asset, mesh, *words)


def cameras(work: Work, data: str) -> dict[str, Any]:
    """Compare estimated cameras with known ones; of a rendered ring if the machinery is tried out."""
    if work.quick:
        return ring(work)
    return _script(work, "bench_cameras", "compare", work.data(data))


def ring(work: Work) -> dict[str, Any]:
    """Compare estimated cameras with the exactly known ones of a rendered ring."""
    folder, size = work.folder / "ring", (work.little(4000, 1000), work.little(3000, 750))
    work.command("bench_cameras", "ring", folder, "--views", work.little(300, 45), "--size", *size)
    return _script(work, "bench_cameras", "compare", folder)


def lookups(work: Work, scene: Scene, bakes: dict[str, str]) -> dict[str, Any]:
    """Measure each view's loss by the number of lookups; `bakes`: parts by the names of their columns."""
    assets = [work.file(name, "asset") for name in bakes.values()]
    words = ("--data", data_of(work, scene), "--views", work.little(50, 2), "--samples", *LOOKUPS)
    found = _script(work, "bench_lookups", *assets, *words)
    return {name: found[str(asset)] for name, asset in zip(bakes, assets, strict=True)}


def compositing(work: Work) -> dict[str, Any]:
    """Compare features composited before the head with colours composited behind it."""
    words = (work.data("lego_400"), "--minutes", work.little(3, "0.02"), "--views", work.little(12, 1))
    return _script(work, "bench_compositing", *words)


def steps(work: Work) -> dict[str, Any]:
    """Measure where the time of a training step goes."""
    little = ("--begin", work.little(1000, 5), "--turns", work.little(20, 2), "--steps", work.little(64, 2))
    return _script(work, "bench_training_step", work.data("lego_400"), "--threads", "2", *little)


def specks(work: Work) -> dict[str, Any]:
    """Count specks of lego's balanced asset that the model's pictures do not have."""
    asset, model = work.file("bake_lego_balanced", "asset"), work.file("train_lego", "model.pt")
    words = (asset, "--model", model, "--data", work.data("lego_400"), "--views", work.little(10, 1))
    return _script(work, "bench_specks", *words)


def _script(work: Work, name: str, *words: str | Path) -> dict[str, Any]:
    work.command(name, *words, "--json", work.folder / "found.json")
    return work.read("found.json")


def of_runs(values: list[float]) -> dict[str, float]:
    """Return the median of a few runs, and the least and the greatest.

    >>> of_runs([3.0, 1.0, 2.0])
    {'median': 2.0, 'low': 1.0, 'high': 3.0, 'n': 3}
    """
    return {
        "median": statistics.median(values),
        "low": min(values),
        "high": max(values),
        "n": len(values),
    }
