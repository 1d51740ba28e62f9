"""What the parts found on two processors, side by side."""

from __future__ import annotations

from collections.abc import Iterator

from tests.benchmarks.pages.cells import duration, give_or_take, machines, megabytes, number, titled
from tests.benchmarks.pages.tables import BAKES, QUALITIES, asset_name
from tests.benchmarks.suite.parts import PAGES, PRESETS
from tests.benchmarks.suite.results import Results
from tests.benchmarks.suite.scenes import SCENES


def _figures(results: Results) -> Iterator[tuple[str, str]]:
    """What is told of the parts that are there, and its figure."""
    for scene in SCENES:
        trained, scored = results.get(f"train_{scene}"), results.get(f"eval_{scene}")
        if trained and scored:
            found, score = trained["figures"], scored["figures"]
            minutes = duration(found["training_seconds"])
            mean = give_or_take(score["psnr"], score["psnr_uncertainty"], 2)
            yield f"{scene}, trained: PSNR", f"{mean} dB in {found['steps']:,} steps, {minutes}"
    for name in BAKES:
        if name in results:
            found = results[name]["figures"]
            lost = give_or_take(found["loss_db"], found["loss_db_spread"], 2)
            size = megabytes(found["n_bytes"])
            yield f"{asset_name(name)}: bake", f"{duration(found['seconds'])}, {size} MB, loses {lost} dB"
    for scene in PRESETS:
        for preset in PRESETS[scene]:
            if played := results.get(f"play_{scene}_{preset}"):
                figures = played["figures"]
                ms = {row["quality"]: row["ms"] for row in figures["rows"] if row["march"] == "numba"}
                rates = ", ".join(number(1000 / ms[quality], 1) for quality in QUALITIES)
                size = "x".join(map(str, figures["size"]))
                yield f"{scene}, {preset}: frames a second at {size}, {', '.join(QUALITIES)}", rates
    for name in PAGES:
        if name in results:
            yield (
                f"{asset_name(name)}: first picture of the page",
                duration(results[name]["figures"]["first_picture_s"]),
            )


def beside(results: Results, second: Results) -> list[str]:
    """The lines of a table with a column for each of the two files of results."""
    columns = [dict(_figures(results)), dict(_figures(second))]
    told = [name for name in columns[0] if name in columns[1]]
    told += [name for name in columns[1] if name not in columns[0]]
    rows = [[name, *(column.get(name, "") for column in columns)] for name in told]
    if not rows:
        return ["Not measured yet on a second processor (`make benchmarks` on one)."]
    titles = []
    for some in (results, second):
        names = [f"{machine['processor']}, {machine['cores']} cores" for machine in machines(some)]
        commits = sorted({part["commit"][:7] for part in some.values()})
        titles.append(f"{' and '.join(names)}; {', '.join(commits)}")
    return titled(["what", *titles], rows, [])
