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

import numpy as np
import pytest
from PIL import Image

from tests.benchmarks.pages.documents import BESIDE, BLOCK, BLOCKS, DOCUMENTS, prose, rendered, rendered_files
from tests.benchmarks.peers.compare import N_PIXELS, chosen_pixels, write_nerfstudio
from tests.benchmarks.suite import conditions
from tests.benchmarks.suite.parts import LONGEST_CORE, LONGEST_PART, PARTS
from tests.benchmarks.suite.results import KEYS, RESULTS, RESULTS_AVX512, read_results, write_results
from tests.benchmarks.suite.runner import Runner, Settings
from tests.benchmarks.suite.work import Part, PartError, Work
from tests.vfr_bake.bench.test_pages import MACHINE
from vfr_bake.config import EFFORT_MINUTES, BenchConfig
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.scene import build_scene

REPOSITORY = Path(__file__).resolve().parent.parent
MEASURED = re.compile(
    r"(?:\d[\s-]?|\b(?:one|two|three|four|five|six|seven|eight|nine|ten|eleven|twelve|half|quarter)"
    r"(?: of)?(?: an?)?[\s-])(?:dB\b|decibels?\b|PSNR\b|[kMG]B\b|ms\b|s\b|min\b|h\b|%|x\b(?!\s?\d)|times|"
    r"frames|fps|(?:milli)?seconds?\b|minutes?\b|hours?\b)"
)
"""Pattern of a number, in digits or in a word, with a unit in which something is measured."""
LIMITS = {
    "README.md": f"at most {max(EFFORT_MINUTES['good']):g} minutes",
    "docs/benchmarks.md": f"at most {LONGEST_CORE:g} minutes",
    "docs/trade.md": f"about {BenchConfig.minutes:g} minutes",
}
"""Pages on which no measured figure may be typed, and what each says of a limit that a program keeps."""


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
    """Return the figures outside the blocks, except those in commands and those published by others. What is
    said behind a command counts."""
    outside = re.sub(r"### Published figures of other systems\n.*?\n## ", "", prose(text), flags=re.DOTALL)
    outside = re.sub(
        r"^```.*?^```",
        lambda code: "\n".join(line.partition(" # ")[2] for line in code[0].splitlines()),
        outside,
        flags=re.DOTALL | re.MULTILINE,
    )
    return MEASURED.findall(re.sub(r"`[^`]*`|\]\([^)]*\)", "", outside, flags=re.DOTALL))


@pytest.mark.parametrize("name", LIMITS)
def test_no_measured_figure_stands_outside_of_the_blocks(name: str) -> None:
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    assert LIMITS[name] in text
    assert measured_figures(text.replace(LIMITS[name], "")) == []


def test_what_to_expect_of_the_readme_is_a_block() -> None:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    section = text.split("## What to expect\n")[1].split("\n## ")[0]
    assert "<!-- benchmarks: expect -->" in section and measured_figures(section) == []


TYPED = """It loses 0.10 dB in 4 kB, 36.2 PSNR and 12 decibels, is 3.5x as fast, and takes 2 hours,
ten seconds, a quarter of an hour, half a minute or 5 to 12 minutes: two and a half hours in all.
```bash
vfr-bake model.pt out/ --minutes 5  # takes 9 minutes
```
"""


def test_a_figure_that_was_typed_in_is_found() -> None:
    assert len(measured_figures(TYPED)) == 12
    assert not measured_figures("<!-- benchmarks: x -->\n3 dB\n<!-- /benchmarks -->")
    assert not measured_figures("One file of 800x800 pixels, 8-bit codes, blocks of 8 x 8, in `1 MB`.")


def test_a_page_without_results_names_the_commands() -> None:
    for name in DOCUMENTS:
        text = rendered((REPOSITORY / name).read_text(encoding="utf-8"), {}, {})
        for found in BLOCK.finditer(text):
            assert re.search(r"`make benchmarks`|`python -m tests.benchmarks --only [\w ]+`", found[0]), (
                found[2]
            )


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


class Clock(conditions.OthersClock):
    """A clock that has measured a given share."""

    def __init__(self, share: float) -> None:
        self._share = share

    def share(self) -> float:
        return self._share


class Bench:
    """A runner of three parts that do next to nothing, with a list of the parts that it ran."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.ran: list[str] = []
        self.others: list[float] = []
        """Shares that other programs take during the next parts that are run; then none."""
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
        runner.clock = lambda: Clock(self.others.pop(0) if self.others else 0.0)
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


def test_a_part_that_was_disturbed_is_measured_once_more(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.others = [0.3, 0.04]
    assert bench.run("train") == ["train", "train"] and not bench.failed
    assert read_results(bench.settings.results)["train"]["others"] == 0.04
    bench.others = [0.3, 0.3]
    assert bench.run("bake", "play") == ["bake", "bake"]
    assert bench.failed["bake"] == (
        "bake: processors: expected other programs to take at most 5% of them, got 30% again: end them, "
        "or give --busy-anyway"
    )
    assert bench.failed["play"] == "play: needs bake"
    assert set(read_results(bench.settings.results)) == {"train"}


def test_a_part_that_was_disturbed_is_kept_where_that_is_wanted(tmp_path: Path) -> None:
    """So is one that only compiles code, and has no figures."""
    bench = Bench(tmp_path)
    bench.parts["compiled"] = Part("compiled", lambda work: {}, 1)
    bench.others = [0.2]
    assert bench.run("compiled") == [] and not bench.failed
    bench.others, bench.settings.busy_anyway = [0.1], True
    assert bench.run("train") == ["train"] and not bench.failed
    recorded = read_results(bench.settings.results)
    assert {name: part["others"] for name, part in recorded.items()} == {"train": 0.1, "compiled": 0.2}


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
    assert part["others"] == 0 and part["libraries"]["numpy"]
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
