"""The tables and plots of the benchmarks' pages, made from results that are written here."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from tests.benchmarks.pages.beside import beside
from tests.benchmarks.pages.cells import lettered, where
from tests.benchmarks.pages.documents import BLOCKS, rendered, rendered_files
from tests.benchmarks.pages.plots import plots
from tests.benchmarks.suite.played import LOOKUPS
from tests.benchmarks.suite.results import KEYS

MACHINE = {"processor": "one", "features": ["avx2"], "cores": 2, "memory_gb": 24}


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
        "peak_mb": 400.0, "first_picture_ms": 1000.0,
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
        "seconds": 200.0, "peak_mb": 900.0, "samples_median": 7, "samples_p95": 25, "loss_db": 0.3,
        "loss_db_spread": 0.1,
    }  # fmt: skip
    for n_bytes, shown in ((5_000_000, True), (5_000_001, False)):
        results = {"bake_lego_balanced": result(found | {"n_bytes": n_bytes}), "trade_lego": TRADE}
        assert ("| 0.08 |" in BLOCKS["baking"](results)[2]) == shown


def test_what_is_chosen_keeps_to_what_was_wanted() -> None:
    lines = BLOCKS["choose"]({"trade_lego": TRADE})
    rows = [line.split(" | ") for line in lines if "| lego" in line]
    assert [row[1:3] + row[4:5] for row in rows] == [
        ["lego, fidelity; k = 5", "-0.02", "17.0"],  # finals: the best quality
        ["lego, balanced; k = 5, `fast`", "0.20", "5.0"],  # fastest, losing at most half a decibel
        ["lego, balanced; k = 5", "0.08", "5.0"],  # best at 5 frames a second
        ["lego, balanced; k = 5", "0.08", "5.0"],  # best at 10 frames a second
        ["lego, fast; k = 5", "0.60", "2.4"],  # best of at most 3 MB
        ["lego, fast; k = 5", "0.60", "2.4"],  # the fewest bytes
    ]
    assert rows[1][3] == "33.3 ± 1.1" and rows[1][5].endswith("--samples 5 --quality fast` |")
    presets = "`fidelity`, `balanced`, `fast`"
    assert lines[-1] == f"Compared presets, and sizes of frames: lego {presets} at 800x800."


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


def test_a_row_tells_what_ran_beside_the_parts_that_it_was_made_from() -> None:
    """A busy machine takes steps from a training or a bake, and so it changes what is made from it. Compiling
    alone, and parts of another machine, change nothing."""
    results = {name: result({}) for name in ("compiled", "train_lego", "bake_lego_fast", "page_lego_fast")}
    results["compiled"] = result({}, others=0.4)
    assert where(results, "page_lego_fast") == "A, 0a1b2c3"
    results["train_lego"] = result({}, others_before=0.4)
    assert [where(results, name) for name in ("train_lego", "bake_lego_fast", "page_lego_fast")] == [
        "A*, 0a1b2c3", "A(*), 0a1b2c3", "A(*), 0a1b2c3",
    ]  # fmt: skip
    results["page_lego_fast"] = result({}, letter="B")
    assert where(results, "page_lego_fast") == "B, 0a1b2c3"
    assert where({"page_lego_fast": result({}, others=0.4)}, "page_lego_fast") == "A*, 0a1b2c3"


def test_the_front_is_that_at_the_size_of_the_plot() -> None:
    """`fast` of a small picture is as fast as `exact`, but at the size of the plot it is faster."""
    rows = [setting("bake_lego_fast", 0.1, 90, 5), setting("bake_lego_fast", 0.2, 30, 5, "fast")]
    for row in rows:
        row["times"]["400x400"] = row["times"]["800x800"] | {"median": 20.0}
        row["on_front"] = False
    figures = {"settings": rows, "conditions": CONDITIONS, "size": "800x800"}
    for size, n_shown in (("800x800", 2), ("400x400", 1)):
        results = {"trade_lego": result(figures | {"size": size})}
        lines = BLOCKS["trade-lego"](results)
        assert sum(line.startswith("| lego, fast") for line in lines) == n_shown
        assert lines[2].startswith(f"Settings are compared at {size}. Test views: 8;")
        assert plots(results)["trade_lego.svg"].count('fill="none" fill-opacity') == 2 - n_shown


def test_losses_name_the_number_of_test_views() -> None:
    """A command may ask for more views than there are."""
    rows = [
        {"march": march, "quality": quality, "ms": 90.0, "uncertainty": 1.0, "peak_mb": 400.0}
        for march in ("numba", "numpy")
        for quality in ("exact", "high", "fast")
    ]
    lost = {quality: {"loss_db": 0.1, "worst_db": 0.2} for quality in ("exact", "high", "fast")}
    command = "python -m tests.benchmarks.bench_qualities asset --views 25 --json play.json"
    played = result({"size": [540, 960], "rows": rows, "losses": lost}, command)
    results = {"play_fox_phone": played, "eval_fox": result({"n_views": 7})}
    for some, n_views in ((results, "7"), ({"play_fox_phone": played}, "")):
        lines = BLOCKS["playing"](some)
        assert lines[2].endswith(f"| 0.4 GB | {n_views} | 0.10, 0.20 | 0.10, 0.20 |")
        assert lines[3].endswith("| 0.4 GB |  |  |  |")


def test_another_viewer_stands_beside_ours() -> None:
    row = {"what": "Open3D, mesh", "ms": 80.0, "uncertainty": 2.0, "processor_ms": 151.2, "psnr": 24.567}
    found = {"size": [800, 800], "n_views": 8, "n_faces": 9, "rows": [row | {"n_bytes": 4.94e6}]}
    assert BLOCKS["viewers"]({"viewers_lego": result(found)})[2:] == [
        "| Open3D, mesh | A, 0a1b2c3 | 12.5 ± 0.3 | 151 | 24.57 | 4.9 |"
    ]


def test_lookups_are_shown_with_the_bytes_of_the_assets() -> None:
    scores = {f"{name}, seed {seed}": {k: [30.0, 31.0, 32.0] for k in LOOKUPS}
              for name in ("every", "k5") for seed in range(3)}  # fmt: skip
    scores["k5, seed 2"] = scores["k5, seed 2"] | {"5": [29.7, 30.4, 31.1]}
    results = {"lookups_lego": result(scores)} | {
        f"bake_lego_seed{seed}_{name}": result({"n_bytes": (mb + seed) * 1e6}, others=0.4 * (seed == 1))
        for name, mb in (("every", 6.0), ("k5", 7.5))
        for seed in range(3)
    }
    _, _, every, k5, *_, place = BLOCKS["lookups"](results)
    assert every.startswith("| lego, every sample | 3 | 6.0 to 8.0 | 0.00 ± 0.00 (0.00 to 0.00) |")
    # Mean losses of the views: 0.1, 0.2 and 0.3; Student's t for two degrees of freedom: 4.303.
    assert k5 == "| lego, 5 lookups | 3 | 7.5 to 9.5 |  |  |  |  | 0.20 ± 0.25 (0.00 to 0.60) |  |  |  |  |"
    assert place == "Machine and commit: A(*), 0a1b2c3."


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


def readme_results(**conditions: Any) -> dict[str, dict[str, Any]]:
    """Return results for the README's table, without those of the preset `fast`."""
    baked = {"seconds": 192.0, "n_bytes": 4.94e6, "loss_db": 0.104, "loss_db_spread": 0.04}
    rows = [
        {"march": march, "quality": quality, "ms": ms, "uncertainty": 0.01 * ms}
        for march, factor in (("numpy", 10), ("numba", 1))
        for quality, ms in (("exact", 90 * factor), ("high", 50 * factor), ("fast", 40 * factor))
    ]
    figures: dict[str, dict[str, Any]] = {
        "train_lego": {"seconds": 570.0},
        "eval_lego": {"psnr": 32.234, "psnr_uncertainty": 0.21, "n_views": 200},
        "bake_lego_balanced": baked,
        "play_lego_balanced": {"size": [800, 800], "rows": rows},
        "page_lego_balanced": {"n_bytes": 5.2e6},
    }
    return {name: result(some, **conditions) for name, some in figures.items()}


def test_the_readme_tells_what_the_parts_found() -> None:
    lines = BLOCKS["expect"](readme_results())
    assert lines[0] == "Lego of NeRF-synthetic at 400x400, no GPU, on 2 cores (one):"
    told = [line.split(" | ")[1].removesuffix(" |") for line in lines[4:7]]
    assert "at 800x800, frames a second by `--quality`, moving between training views" in lines[6]
    assert told == [
        "9.5 minutes, 32.23 ± 0.21 dB mean PSNR on all 200 test views",
        "3.2 minutes, 4.9 MB; as a page 5.2 MB; loses 0.10 ± 0.04 dB against photographs",
        "exact 11.1 ± 0.1, high 20.0 ± 0.2, fast 25.0 ± 0.2",
    ]
    lacking = "bake_lego_fast, play_lego_fast, page_lego_fast"
    assert lines[7:] == ["", f"Not measured yet: {lacking} (`make benchmarks`)."]
    assert BLOCKS["expect"]({})[0].startswith("Not measured yet: train_lego, eval_lego, bake_lego_balanced")


def test_the_readme_names_the_machine_that_the_figures_are_of() -> None:
    """A file of results may begin with a part that the README does not show, of a machine that it does not
    name."""
    text, another = "<!-- benchmarks: expect -->\n<!-- /benchmarks -->", MACHINE | {"processor": "another"}
    found = rendered(text, {"compiled": result({})}, readme_results(machine=another)).splitlines()
    assert found[2] == "Lego of NeRF-synthetic at 400x400, no GPU, on 2 cores (another):"
    assert found[4] == "| what | figure |"
    first = {name: part for name, part in readme_results().items() if name != "play_lego_balanced"}
    found = rendered(text, first, readme_results(machine=another)).splitlines()
    assert found[2].endswith("no GPU, on A: 2 cores (one); B: 2 cores (another):")
    assert found[4] == "| what | figure | machine |"
    assert [line.split(" | ")[2] for line in found[6:9]] == ["A |", "A |", "B |"]


def test_a_plot_is_drawn_of_the_file_that_its_table_is_of() -> None:
    files = rendered_files({"trade_lego": TRADE}, {"trade_can": TRADE})
    assert {path.name for path in files if path.suffix == ".svg"} == {"trade_lego.svg", "trade_can.svg"}


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
