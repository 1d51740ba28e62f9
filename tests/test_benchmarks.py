"""The benchmarks' machinery, and a check that the documents show the figures in the file of results."""

from __future__ import annotations

import doctest
import importlib
import json
import re
import subprocess
import sys
from collections.abc import Callable
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from tests.benchmarks.pages.beside import beside
from tests.benchmarks.pages.cells import lettered
from tests.benchmarks.pages.documents import BESIDE, BLOCK, BLOCKS, DOCUMENTS, prose, rendered, rendered_files
from tests.benchmarks.pages.plots import plots
from tests.benchmarks.peers.compare import N_PIXELS, chosen_pixels, write_nerfstudio
from tests.benchmarks.suite import conditions
from tests.benchmarks.suite.parts import LONGEST_CORE, LONGEST_PART, PARTS
from tests.benchmarks.suite.results import KEYS, RESULTS, RESULTS_AVX512, read_results, write_results
from tests.benchmarks.suite.runner import Runner, Settings
from tests.benchmarks.suite.work import Part, PartError, Work
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.scene import build_scene

REPOSITORY = Path(__file__).resolve().parent.parent
MACHINE = {"processor": "one", "features": ["avx2"], "cores": 2, "memory_gb": 24}
MEASURED = re.compile(r"\d\s?(?:dB\b|[MG]B\b|ms\b|s\b|min\b|%|frames|fps|seconds|minutes|times)")
"""Pattern of a number with a unit in which something is measured."""


# Documents ----------------------------------------------------------------------------------------


def test_documents_and_plots_are_what_the_results_give() -> None:
    files = rendered_files(read_results(), read_results(RESULTS_AVX512))
    wrong = [path.name for path, data in files.items() if not path.is_file() or path.read_bytes() != data]
    assert wrong == [], "run: python -m tests.benchmarks render"
    plots = {path.name for path in (REPOSITORY / "docs").glob("trade_*.svg")}
    assert plots <= {path.name for path in files}


def test_every_block_is_shown_once_and_known() -> None:
    shown = [
        found[2]
        for name in DOCUMENTS
        for found in BLOCK.finditer((REPOSITORY / name).read_text(encoding="utf-8"))
    ]
    assert sorted(shown) == sorted([*BLOCKS, *BESIDE])
    others = [path for path in (REPOSITORY / "docs").rglob("*.md")
              if path.relative_to(REPOSITORY).as_posix() not in DOCUMENTS]  # fmt: skip
    assert [path.name for path in others if "<!-- benchmarks:" in path.read_text(encoding="utf-8")] == []


def measured_figures(text: str) -> list[str]:
    """Return the figures outside the blocks, except those in commands and those published by others."""
    outside = re.sub(r"### Published figures of other systems\n.*?\n## ", "", prose(text), flags=re.DOTALL)
    outside = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", outside, flags=re.DOTALL)
    return MEASURED.findall(outside)


@pytest.mark.parametrize("name", ["docs/benchmarks.md", "docs/trade.md"])
def test_no_measured_figure_stands_outside_of_the_blocks(name: str) -> None:
    assert measured_figures((REPOSITORY / name).read_text(encoding="utf-8")) == []


def test_what_to_expect_of_the_readme_is_a_block() -> None:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    section = text.split("## What to expect\n")[1].split("\n## ")[0]
    assert "<!-- benchmarks: expect -->" in section and measured_figures(section) == []


def test_a_figure_that_was_typed_in_is_found() -> None:
    assert measured_figures("It loses 0.10 dB in `1 MB`.\n<!-- benchmarks: x -->\n3 dB\n<!-- /benchmarks -->")
    assert not measured_figures("<!-- benchmarks: x -->\n3 dB\n<!-- /benchmarks -->")


def test_a_page_without_results_names_the_commands() -> None:
    for name in DOCUMENTS:
        text = rendered((REPOSITORY / name).read_text(encoding="utf-8"), {}, {})
        for found in BLOCK.finditer(text):
            assert re.search(r"`make benchmarks`|`python -m tests.benchmarks --only [\w ]+`", found[0]), (
                found[2]
            )


# Tables -------------------------------------------------------------------------------------------


def result(figures: dict[str, Any], *commands: str, **conditions: Any) -> dict[str, Any]:
    """Return a part's result in the form in which it is recorded."""
    versions = dict.fromkeys(("python", "numpy", "numba", "onnxruntime", "torch"), "1.0")
    usual = {"commit": "0a1b2c3d4e", "machine": MACHINE, "letter": "A", "others_before": 0.0, "others": 0.01}
    kept = dict.fromkeys(KEYS) | usual | {"date": "2026-11-24", "libraries": versions, "commands": commands}
    return kept | {"figures": figures} | conditions


def setting(asset: str, loss: float, ms: float, mb: float, quality: str = "exact") -> dict[str, Any]:
    """Return one row of the table of the trade."""
    return {
        "asset": asset, "n_fetches": 5, "quality": quality, "what": {"n_fetches": 5}, "n_bytes": mb * 1e6,
        "on_front": True, "peak_mb": 400.0, "first_picture_ms": 1000.0,
        "scores": {"psnr": 32 - loss, "loss_db": loss, "ssim": 0.97, "psnr_to_model": 40.0},
        "times": {"800x800": {"median": ms, "uncertainty": 1.0, "march": 9.0, "lookups": 9.0, "head": 9.0}},
    }  # fmt: skip


ROWS = [
    setting("bake_lego_fidelity", -0.02, 300, 17),
    setting("bake_lego_balanced", 0.08, 90, 5),
    setting("bake_lego_balanced", 0.2, 30, 5, "fast"),
    setting("bake_lego_fast", 0.6, 70, 2.4),
]
CONDITIONS = {"n_views": 8, "threads": 2, "frames_a_setting_and_size": 12}
TRADE = result({"settings": ROWS, "conditions": CONDITIONS, "size": "800x800"})


def test_a_loss_on_test_views_is_that_of_the_same_asset() -> None:
    """A bake's row shows the loss on test views from the trade only if the asset has the same size in bytes:
    a bake that was measured again since is another asset."""
    found = {
        "resolution": 594, "feature_resolution": 460, "n_channels": 16, "n_fetches": 5, "n_vertices": 6e6,
        "bytes": {"manifest.json": 12_000}, "seconds": 200.0, "peak_mb": 900.0, "samples_median": 7,
        "samples_p95": 25, "loss_db": 0.3, "loss_db_spread": 0.1,
    }  # fmt: skip
    for n_bytes, shown in ((5_012_000, True), (5_012_001, False)):
        results = {"bake_lego_balanced": result(found | {"n_bytes": n_bytes}), "trade_lego": TRADE}
        assert ("| 0.08 |" in BLOCKS["baking"](results)[2]) == shown


def test_what_is_chosen_keeps_to_what_was_wanted() -> None:
    rows = [line.split(" | ") for line in BLOCKS["choose"]({"trade_lego": TRADE}) if "| lego" in line]
    assert [row[1:3] + row[4:5] for row in rows] == [
        ["lego, fidelity; k = 5", "-0.02", "17.0"],  # finals: the best quality
        ["lego, balanced; k = 5, `fast`", "0.20", "5.0"],  # fastest, losing at most half a decibel
        ["lego, balanced; k = 5", "0.08", "5.0"],  # best at 5 frames a second
        ["lego, balanced; k = 5", "0.08", "5.0"],  # best at 10 frames a second
        ["lego, fast; k = 5", "0.60", "2.4"],  # best of at most 3 MB
        ["lego, fast; k = 5", "0.60", "2.4"],  # the fewest bytes
    ]
    assert rows[1][3] == "33.3 ± 1.1" and rows[1][5].endswith("--samples 5 --quality fast` |")


def test_a_wish_that_nothing_fits_is_told() -> None:
    slow = result({"settings": ROWS[:1], "conditions": CONDITIONS, "size": "800x800"})
    assert sum("none of these" in line for line in BLOCKS["choose"]({"trade_lego": slow})) == 3


def test_a_row_tells_machine_commit_and_what_ran_beside() -> None:
    trained = {"steps": 18_920, "training_seconds": 555.0, "seconds": 570.0, "peak_mb": 1100.0}
    command = "vfr-train lego_400 train_lego/model.pt --json train_lego/train.json --minutes 9.25"
    scored = {"psnr": 32.234, "psnr_uncertainty": 0.21, "n_views": 200, "ssim": 0.969}
    results = {"train_lego": result(trained, command), "eval_lego": result(scored)}
    told = "`vfr-train lego_400 train_lego/model.pt --minutes 9.25`"
    took = "9.2 min training, 9.5 min in all; 1.1 GB"
    score = "**32.23 ± 0.21 dB** (200 views), SSIM 0.969"
    lines = BLOCKS["training"](results)
    assert lines[2] == f"| lego | {told} | A, 0a1b2c3 | 18,920 | {took} | {score} |"
    assert lines[-1] == "Not measured yet: train_fox, train_can, train_demo (`make benchmarks`)."
    results["train_lego"] = result(trained, command, machine=MACHINE | {"cores": 4}, others=0.4)
    assert "| A*, 0a1b2c3 |" in BLOCKS["training"](results)[2]
    assert len(BLOCKS["machines"](lettered(results)[0])) == 4


def test_two_processors_stand_side_by_side() -> None:
    baked = {"seconds": 192.0, "n_bytes": 4.94e6, "loss_db": 0.104, "loss_db_spread": 0.04}
    first = {"bake_lego_fast": result(baked), "page_lego_fast": result({"first_picture_s": 2.0})}
    other = MACHINE | {"processor": "another"}
    second = {"bake_lego_fast": result(baked | {"seconds": 480.0}, machine=other)}
    assert beside(*lettered(first, second)) == [
        "| what | one, 2 cores; 0a1b2c3 | another, 2 cores; 0a1b2c3 |",
        "|---|---|---|",
        "| lego, fast: bake | 192 s, 4.9 MB, loses 0.10 ± 0.04 dB | 8.0 min, 4.9 MB, loses 0.10 ± 0.04 dB |",
    ]


def test_rows_name_the_machine_where_a_second_file_has_several() -> None:
    baked = {"seconds": 192.0, "n_bytes": 4.94e6, "loss_db": 0.104, "loss_db_spread": 0.04}
    second = {
        "page_lego_fast": result({"first_picture_s": 2.0}, machine=MACHINE | {"processor": "another"}),
        "bake_lego_fast": result(baked, machine=MACHINE | {"processor": "a third"}, others=0.4),
    }
    assert beside(*lettered({"bake_lego_fast": result(baked)}, second)) == [
        "| what | one, 2 cores; 0a1b2c3 | B: another, 2 cores; C: a third, 2 cores |",
        "|---|---|---|",
        "| lego, fast: bake | 192 s, 4.9 MB, loses 0.10 ± 0.04 dB |"
        " 192 s, 4.9 MB, loses 0.10 ± 0.04 dB (C*, 0a1b2c3) |",
        "| lego, fast: first picture of the page |  | 2.0 s (B, 0a1b2c3) |",
    ]


def test_a_part_that_the_first_file_lacks_is_of_the_second() -> None:
    features = {"psnr": 31.0, "n_views": 12, "steps": 300, "minutes": 3.0}
    found: dict[str, Any] = {"features": features, "colour": features | {"psnr": 30.0, "steps": 100}}
    other = {"compositing_lego": result(found, machine=MACHINE | {"processor": "another"})}
    text = "<!-- benchmarks: compositing -->\n<!-- /benchmarks -->"
    row = "| lego, 3 minutes | B, 0a1b2c3 | 31.00 dB (12 views) | 30.00 dB (12 views) | 3.0 times as many |"
    assert row in rendered(text, {"bake_lego_fast": result({})}, other)
    assert "| A, 0a1b2c3 |" in rendered(text, {"compositing_lego": result(found)}, other)


def test_the_readme_tells_what_the_parts_found() -> None:
    baked = {"seconds": 192.0, "n_bytes": 4.94e6, "loss_db": 0.104, "loss_db_spread": 0.04}
    rows = [
        {"march": march, "quality": quality, "ms": ms}
        for march, factor in (("numpy", 10), ("numba", 1))
        for quality, ms in (("exact", 90 * factor), ("high", 50 * factor), ("fast", 40 * factor))
    ]
    results = {
        "train_lego": result({"seconds": 570.0}),
        "eval_lego": result({"psnr": 32.234, "n_views": 200}),
        "bake_lego_balanced": result(baked),
        "play_lego_balanced": result({"size": [800, 800], "rows": rows}),
        "page_lego_balanced": result({"n_bytes": 5.2e6}),
    }
    lines = BLOCKS["expect"](results)
    assert lines[0] == "Lego of NeRF-synthetic at 400x400, no GPU, on 2 cores (one):"
    told = [line.split(" | ")[1].removesuffix(" |") for line in lines[4:7]]
    assert told == [
        "9.5 minutes, 32.23 dB mean PSNR on all 200 test views",
        "3.2 minutes, 4.9 MB; as a page 5.2 MB; loses 0.10 ± 0.04 dB against photographs",
        "exact 11.1, high 20.0, fast 25.0",
    ]
    lacking = "bake_lego_fast, play_lego_fast, page_lego_fast"
    assert lines[7:] == ["", f"Not measured yet: {lacking} (`make benchmarks`)."]
    assert BLOCKS["expect"]({})[0].startswith("Not measured yet: train_lego, eval_lego, bake_lego_balanced")


def test_cameras_are_told_by_stage() -> None:
    off = {"root_mean_square": 0.052, "greatest": 0.087}
    found = {
        "seconds": 220.0,
        "peak_mb": 617.0,
        "turns": off,
        "places": off,
        "n_placed": 45,
        "n_pictures": 45,
    }
    found["stages"] = {"features": [42.8, 15.6], "cameras": [5.2, 2.4]}
    row = BLOCKS["cameras"]({"cameras_fox": result(found)})[2]
    took = "220 s (features 43 s, cameras 5.2 s); 0.6 GB"
    assert (
        row == f"| fox | A, 0a1b2c3 | {took} | 45 of 45 | 0.052 % (at most 0.087) | 0.052 (at most 0.087) |"
    )


def test_plots_have_a_mark_for_every_setting() -> None:
    ((name, picture),) = plots({"trade_lego": TRADE}).items()
    marks = ElementTree.fromstring(picture).findall("{http://www.w3.org/2000/svg}circle/*")
    assert name == "trade_lego.svg" and len(marks) == len(ROWS)
    assert marks[0].text == "k = 5, exact: 32.02 dB, 3.33 frames a second, 17.0 MB"


# Results ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [RESULTS, RESULTS_AVX512])
def test_the_committed_results_are_of_parts_that_there_are(path: Path) -> None:
    parts = read_results(path)
    assert set(parts) <= set(PARTS)
    text = path.read_text(encoding="utf-8")
    assert not re.search(r'"/|~/|\\\\', text), "folders of a machine"
    assert all(part["seconds"] <= 60 * LONGEST_PART for part in parts.values())
    assert sum(parts[name]["seconds"] for name in parts if PARTS[name].core) <= 60 * LONGEST_CORE


def test_parts_keep_to_their_time_and_need_what_there_is() -> None:
    assert all(part.minutes <= LONGEST_PART for part in PARTS.values())
    assert sum(part.minutes for part in PARTS.values() if part.core) <= LONGEST_CORE
    assert all(PARTS[name].core for part in PARTS.values() if part.core for name in part.needs)
    order = [*TopologicalSorter({name: part.needs for name, part in PARTS.items()}).static_order()]
    assert set(order) == set(PARTS)


# Running ------------------------------------------------------------------------------------------


class Bench:
    """A runner of three parts that do next to nothing, with a list of the parts that it ran."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.ran: list[str] = []
        self.settings = Settings(folder / "work", folder, folder / "benchmarks.json", **settings)
        self.parts = {
            "train": Part("train", self._measure(), 1),
            "bake": Part("bake", self._measure(), 1, ("train",)),
            "play": Part("play", self._measure(), 1, ("bake",)),
        }

    def _measure(self) -> Callable[[Work], dict[str, Any]]:
        def measure(work: Work) -> dict[str, Any]:
            self.ran.append(work.part)
            (work.folder / "file").write_text(work.part)
            return {"psnr": 30.123456789}

        return measure

    def run(self, *names: str, commit: str = "0a", machine: dict[str, Any] = MACHINE) -> list[str]:
        self.ran.clear()
        runner = Runner(self.parts, self.settings, commit, machine)
        runner.quiet, runner.settle = lambda: 0.01, lambda: None
        self.failed = runner.run(names)
        return self.ran


def test_a_part_is_run_once_for_a_commit_and_a_machine(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert bench.run("bake", "train", "play") == ["train", "bake", "play"]
    assert bench.run("bake", "play") == []
    assert bench.run("bake", commit="0b") == ["train", "bake"]
    assert bench.run("play", machine=MACHINE | {"cores": 4}) == ["train", "bake", "play"]
    bench.settings.again = True
    assert bench.run("play", machine=MACHINE | {"cores": 4}) == ["play"]


def test_what_a_part_needs_is_made_again_where_its_files_are_gone(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.run("bake")
    (bench.settings.root / "train" / "whole").unlink()
    assert bench.run("train", "bake") == []
    assert bench.run("play") == ["play"]
    (bench.settings.root / "bake" / "whole").unlink()
    bench.settings.again = True
    assert bench.run("play") == ["train", "bake", "play"]


def test_an_interrupted_run_goes_on_and_a_failed_part_stops_what_needs_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path)

    def fails(work: Work) -> dict[str, Any]:
        (work.folder / "half").touch()
        raise PartError("bake: vfr-bake ended with 1")

    bench.parts["bake"] = Part("bake", fails, 1, ("train",))
    assert bench.run("play") == ["train"]
    assert bench.failed == {"bake": "bake: vfr-bake ended with 1", "play": "play: needs bake"}
    assert set(read_results(bench.settings.results)) == {"train"}
    bench.parts["bake"] = Part("bake", bench._measure(), 1, ("train",))
    assert bench.run("play") == ["bake", "play"]
    assert not (bench.settings.root / "bake" / "half").exists()


def test_a_data_set_that_is_missing_fails_its_part_alone(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.parts["lost"] = Part("lost", bench._measure(), 1, data="lego_400")
    assert bench.run("lost", "train") == ["train"]
    assert "lego_400: expected a data set, found none" in bench.failed["lost"]


def test_a_result_has_the_conditions_and_survives_the_file(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.run("train")
    (part,) = read_results(bench.settings.results).values()
    assert set(part) == KEYS and part["figures"] == {"psnr": 30.1235}
    assert part["commit"] == "0a" and part["machine"] == MACHINE and part["others_before"] == 0.01
    assert 0 <= part["others"] <= 1 and part["libraries"]["numpy"]
    document = json.loads(bench.settings.results.read_text(encoding="utf-8"))
    del document["parts"]["train"]["seeds"]
    bench.settings.results.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ValueError, match=r"train: expected the keys .*seeds"):
        read_results(bench.settings.results)


def test_parts_are_recorded_in_their_order(tmp_path: Path) -> None:
    some = {name: dict.fromkeys(KEYS) for name in ("play", "train", "of another time")}
    write_results(some, ["train", "bake", "play"], tmp_path / "found.json")
    assert [*read_results(tmp_path / "found.json")] == ["train", "play"]


def test_commands_are_told_without_folders_of_the_machine(tmp_path: Path) -> None:
    work = Work("bake", tmp_path / "work", tmp_path / "data")
    words = [str(work.file("train", "model.pt")), str(work.folder / "asset"), "--data", work.data("lego_400")]
    assert work.told("vfr-bake", words) == "vfr-bake train/model.pt bake/asset --data lego_400"
    assert work.told("bench_page", []).strip() == "python -m tests.benchmarks.bench_page"
    assert work.data("demo") == "demo"


def test_a_command_that_fails_is_a_failed_part(tmp_path: Path) -> None:
    work = Work("bake", tmp_path, tmp_path)
    with pytest.raises(PartError, match="bake: vfr-play ended with 2"):
        work.command("vfr-play", "--no-such-option")
    usage = work.command("vfr-play", "--help")
    assert 0 < usage.processor_seconds and usage.peak_mb > 5 and len(work.commands) == 2


# Conditions ---------------------------------------------------------------------------------------


def wait(shares: list[float], **settings: Any) -> tuple[float, list[str]]:
    """Wait until the machine is quiet, if looks a minute apart find these shares of it in use by other
    programs. Return the last share and the lines that were printed."""
    said: list[str] = []
    minutes = iter(range(100))
    share = conditions.wait_until_quiet(
        settings.get("minutes", 5), settings.get("anyway", False), said.append,
        lambda: shares.pop(0), lambda: 60.0 * next(minutes),
    )  # fmt: skip
    return share, said


def test_a_busy_machine_is_waited_for() -> None:
    assert wait([0.01]) == (0.01, [])
    share, said = wait([0.6, 0.3, 0.02])
    assert share == 0.02 and len(said) == 2
    assert said[0] == "other programs take 60% of the processors: waiting, 1.0 of 5 minutes"


def test_a_machine_that_stays_busy_is_refused_unless_that_is_wanted() -> None:
    with pytest.raises(conditions.BusyError, match="at most 5% of them, got 60% after 5 minutes"):
        wait([0.6] * 9)
    share, said = wait([0.6] * 9, anyway=True)
    assert (
        share == 0.6
        and said[-1] == "other programs take 60% of the processors: measured beside them, as asked"
    )


ORPHAN = """
import os, subprocess, sys
from tests.benchmarks.suite import conditions
conditions.adopt_orphans()
loop = "import time; end = time.process_time() + 0.2\\nwhile time.process_time() < end: pass"
subprocess.run(["sh", "-c", f'{sys.executable} -c "$0" & exit 0', loop])
conditions.bury_orphans()
print(sum(os.times()[2:4]))
"""


def test_what_a_child_leaves_behind_counts_as_ours() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ORPHAN], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert float(done.stdout) > 0.2


def test_the_machine_without_flags_or_a_name_is_told_all_the_same() -> None:
    found = conditions.parse_machine("", "")
    assert found["processor"] and found["features"] == [] and found["memory_gb"] is None


def test_another_tool_is_given_the_views_that_are_learned_from_and_held_out(tmp_path: Path) -> None:
    scene = build_scene(demo_capture(size=16, n_train=6, n_test=2), "unbounded")
    write_nerfstudio(scene, tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))["frames"]
    splits = [frame["file_path"].split("_")[1] for frame in frames]
    assert splits == ["train"] * 6 + ["eval"] * 2
    views = [
        (view, camera)
        for part in (scene.train, scene.test)
        for view, camera in zip(part.images, part.cameras, strict=True)
    ]
    for frame, (view, camera) in zip(frames, views, strict=True):
        with Image.open(tmp_path / frame["file_path"]) as picture:
            assert np.array_equal(np.asarray(picture), view[..., :3])
        assert np.array_equal(frame["transform_matrix"], camera.c2w) and frame["fl_x"] == camera.fx


def test_pixels_of_every_test_view_are_looked_at() -> None:
    scene = build_scene(demo_capture(size=16, n_train=6, n_test=2))
    places = chosen_pixels(scene)
    assert places.shape == (2, N_PIXELS // 2, 2) and places.min() == 0 and places.max() == 15


MODULES = [
    f"tests.benchmarks.{path.parent.name}.{path.stem}"
    for folder in ("pages", "suite")
    for path in sorted((REPOSITORY / "tests" / "benchmarks" / folder).glob("*.py"))
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_the_machinery(name: str) -> None:
    module = importlib.import_module(name)
    assert doctest.testmod(module).failed == 0
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    assert module.__doc__ and source.count("\n") <= 500
