"""docs/benchmarks.md: trains, bakes, plays and measures whole scenes, by the commands that a user has.

    python tests/benchmarks/bench_trade.py demo ../shared/data/lego_400 --output /tmp/trade
    python tests/benchmarks/bench_trade.py ../shared/data/fox --output /tmp/trade --downscale 2 \\
        --minutes 2 5 12 --presets balanced

prints the tables of docs/benchmarks.md. Each scene is trained for each of `--minutes`; from the last model
every preset is baked, and `vfr-bench` measures them all. What is in the output folder already is used as it
is, so that an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

COMMANDS = {
    name: f"import sys, vfr_bake.cli as c; sys.exit(c.{name[4:]}_main())"
    for name in ("vfr-train", "vfr-bake", "vfr-eval", "vfr-bench")
}
TITLES = (
    *("setting", "PSNR", "loss, dB", "SSIM", "dB to the model", "ms a frame", "march", "lookups", "head"),
    *("MB", "front"),
)


def run(name: str, *arguments: str) -> None:
    print(f"$ {name} {' '.join(arguments)}", file=sys.stderr, flush=True)
    if subprocess.run([sys.executable, "-c", COMMANDS[name], *arguments], stdout=sys.stderr).returncode:
        raise SystemExit(f"{name} failed")


def measure(data: str, out: Path, options: argparse.Namespace) -> dict[str, Any]:
    """The trade of one scene, and PSNR by minutes of training."""
    training = ["--eval-views", "0", "--downscale", options.downscale]
    out.mkdir(parents=True, exist_ok=True)
    learned = {}
    for some in options.minutes:
        model, report = out / f"model_{some:g}.pt", out / f"eval_{some:g}.json"
        if not model.exists():
            run("vfr-train", data, str(model), "--minutes", str(some), *training)
        if not report.exists():
            run("vfr-eval", str(model), data, "--json", str(report))
        learned[some] = json.loads(report.read_text())["psnr"]
    assets = [out / preset for preset in options.presets]
    for asset in assets:
        if not asset.exists():
            run("vfr-bake", str(model), str(asset), "--preset", asset.name)
    if not (out / "trade.json").exists():
        page = ["--html", str(out / "trade.html"), "--json", str(out / "trade.json"), "--force"]
        folders = [str(asset) for asset in assets]
        extra = ["--views", options.views, "--frames", options.frames, "--sizes", *options.sizes]
        run("vfr-bench", *folders, "--data", data, "--model", str(model), *page, *extra)
    return {"learned": learned, **json.loads((out / "trade.json").read_text())}


def table(titles: list[str], rows: list[list[str]]) -> list[str]:
    """Markdown."""
    return [f"| {' | '.join(row)} |" for row in (titles, ["---"] * len(titles), *rows)]


def section(name: str, trade: dict[str, Any], out: Path) -> list[str]:
    """The scene in Markdown."""
    conditions, learned = trade["conditions"], trade["learned"]
    width, height = conditions["front_at"]
    lines = [f"\n## {name}", trade["recommendation"].replace(f"{out}/", ""), ""]
    titles = ["minutes of training", *(f"{minutes:g}" for minutes in learned)]
    lines += table(titles, [["full model, all test views, dB", *(f"{p:.2f}" for p in learned.values())]])
    lines += [
        "",
        f"{len(conditions['views'])} test views, {width}x{height}, "
        f"{conditions['frames_a_setting_and_size']} frames a setting, {conditions['threads']} threads, "
        f"{conditions['march']}:",
        "",
    ]
    rows = []
    for row in trade["settings"]:
        scores, times = row["scores"], row["times"][f"{width}x{height}"]
        parts = [times[key] if row["asset"] else None for key in ("march", "lookups", "head")]
        near = scores["psnr_to_model"]
        rows.append(
            [
                row["name"].replace(f"{out}/", ""),
                f"{scores['psnr']:.2f}",
                f"{scores['loss_db']:.2f}",
                f"{scores['ssim']:.4f}",
                "" if near is None else f"{near:.1f}",
                f"{times['median']:.0f} ±{times['uncertainty']:.0f}",
                *("" if part is None else f"{part:.0f}" for part in parts),
                f"{row['n_bytes'] / 1e6:.1f}",
                "yes" if row["on_front"] else "",
            ]
        )
    return [*lines, *table(list(TITLES), rows), "", *loss_against_k(trade, out)]


def loss_against_k(trade: dict[str, Any], out: Path) -> list[str]:
    """What fewer lookups lose against all samples, by asset."""
    rows = [row for row in trade["settings"] if row["asset"]]
    ks = list(dict.fromkeys(row["n_fetches"] for row in rows))
    lines = []
    for asset in dict.fromkeys(row["asset"] for row in rows):
        psnr = {row["n_fetches"]: row["scores"]["psnr"] for row in rows if row["asset"] == asset}
        lines.append([asset.replace(f"{out}/", ""), *(f"{psnr[0] - psnr[k]:.2f}" for k in ks)])
    return table(["lost against every sample, dB; k =", *(str(k or "all") for k in ks)], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", help="data sets, or demo")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--downscale", default="1", help="of vfr-train")
    parser.add_argument("--minutes", type=float, nargs="+", default=[1, 2, 5, 10])
    parser.add_argument("--presets", nargs="+", default=["fidelity", "balanced", "fast"])
    parser.add_argument("--views", default="8", help="of vfr-bench")
    parser.add_argument("--frames", default="20", help="of vfr-bench")
    parser.add_argument("--sizes", nargs="*", default=[], help="of vfr-bench")
    options = parser.parse_args()
    lines = []
    for data in options.scenes:
        out = options.output / Path(data).name
        trade = measure(data, out, options)
        lines += section(Path(data).name, trade, out)
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
