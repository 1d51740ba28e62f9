"""Results of two processors, side by side."""

from __future__ import annotations

from collections.abc import Iterator

from tests.benchmarks.against import QUALITIES
from tests.benchmarks.pages.cells import (
    duration,
    give_or_take,
    machines,
    megabytes,
    number,
    titled,
    where,
)
from tests.benchmarks.pages.tables import BAKES, asset_name
from tests.benchmarks.suite.parts import PAGES, PRESETS
from tests.benchmarks.suite.results import Results
from tests.benchmarks.suite.scenes import SCENES


def _figures(results: Results) -> Iterator[tuple[str, str, str]]:
    """Yield the name of each figure of the recorded parts, the figure, and the part that found it."""
    for scene in SCENES:
        trained, scored = results.get(f"train_{scene}"), results.get(f"eval_{scene}")
        if trained and scored:
            found, score = trained["figures"], scored["figures"]
            minutes = duration(found["training_seconds"])
            mean = give_or_take(score["psnr"], score["psnr_uncertainty"], 2)
            told = f"{mean} dB in {found['steps']:,} steps, {minutes}"
            yield f"{scene}, trained: PSNR", told, f"train_{scene}"
    for name in BAKES:
        if name in results:
            found = results[name]["figures"]
            lost = give_or_take(found["loss_db"], found["loss_db_spread"], 2)
            size = megabytes(found["n_bytes"])
            told = f"{duration(found['seconds'])}, {size} MB, loses {lost} dB"
            yield f"{asset_name(name)}: bake", told, name
    for scene in PRESETS:
        for preset in PRESETS[scene]:
            name = f"play_{scene}_{preset}"
            if played := results.get(name):
                figures = played["figures"]
                ms = {row["quality"]: row["ms"] for row in figures["rows"] if row["march"] == "numba"}
                rates = ", ".join(number(1000 / ms[quality], 1) for quality in QUALITIES)
                size = "x".join(map(str, figures["size"]))
                yield f"{scene}, {preset}: frames a second at {size}, {', '.join(QUALITIES)}", rates, name
    for name in PAGES:
        if name in results:
            seconds = results[name]["figures"]["first_picture_s"]
            yield f"{asset_name(name)}: first picture of the page", duration(seconds), name


def _column(results: Results) -> tuple[str, dict[str, str]]:
    """Return the title of a file's column, and each figure by its name. If these figures are of several
    machines, each has its machine and commit."""
    figures = {what: (figure, name) for what, figure, name in _figures(results)}
    shown = {name: results[name] for _, name in figures.values()}
    places = {at: f"{of['processor']}, {of['cores']} cores" for at, of in machines(shown).items()}
    if len(places) > 1:
        title = "; ".join(f"{letter}: {place}" for letter, place in places.items())
        return title, {what: f"{figure} ({where(results, name)})" for what, (figure, name) in figures.items()}
    commits = sorted({part["commit"][:7] for part in shown.values()})
    title = f"{' and '.join(places.values())}; {', '.join(commits)}"
    return title, {what: figure for what, (figure, _) in figures.items()}


def beside(results: Results, second: Results) -> list[str]:
    """Return the lines of a table with a column for each of the two files of results."""
    titles, columns = zip(_column(results), _column(second), strict=True)
    told = [name for name in columns[0] if name in columns[1]]
    told += [name for name in columns[1] if name not in columns[0]]
    rows = [[name, *(column.get(name, "") for column in columns)] for name in told]
    if not rows:
        return ["Not measured yet on a second processor (`make benchmarks` on one)."]
    return titled(["what", *titles], rows, [])
