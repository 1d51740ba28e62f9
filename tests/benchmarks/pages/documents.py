"""Documents with figures of the benchmarks. Each block stands between two comments, and is made from the
results.

<!-- benchmarks: NAME -->
what `BLOCKS[NAME]` makes of the results, or `BESIDE[NAME]` of those of two processors
<!-- /benchmarks -->
"""

from __future__ import annotations

import re
from pathlib import Path

from player.files.files import write_bytes
from tests.benchmarks.pages import tables, trade
from tests.benchmarks.pages.beside import beside
from tests.benchmarks.pages.cells import lettered
from tests.benchmarks.pages.plots import plots
from tests.benchmarks.suite.conditions import REPOSITORY
from tests.benchmarks.suite.results import Results

BLOCKS = tables.BLOCKS | trade.BLOCKS
BESIDE = {"beside": beside}
DOCUMENTS = ("README.md", "docs/bake.md", "docs/benchmarks.md", "docs/trade.md")
BLOCK = re.compile(r"(<!-- benchmarks: ([\w-]+) -->\n).*?(<!-- /benchmarks -->)", re.DOTALL)


def merged(results: Results, second: Results) -> Results:
    """Return the parts of both files; those of `second` stand in for those that `results` lacks."""
    return results | {name: part for name, part in second.items() if name not in results}


def rendered(text: str, results: Results, second: Results) -> str:
    """Return a document with its blocks made anew. Raises KeyError for an unknown block.

    `results`: of a processor without AVX-512; `second`: of one with it, whose parts also stand in for those
    that `results` lacks.
    """
    results, second = lettered(results, second)
    whole = merged(results, second)

    def block(found: re.Match[str]) -> str:
        name = found[2]
        lines = BESIDE[name](results, second) if name in BESIDE else BLOCKS[name](whole)
        return "\n".join([found[1], *lines, "", found[3]])

    return BLOCK.sub(block, text)


def prose(text: str) -> str:
    """Return a document without its blocks."""
    return BLOCK.sub("", text)


def rendered_files(results: Results, second: Results) -> dict[Path, bytes]:
    """Return the content of each file, documents and plots."""
    files = {}
    for name in DOCUMENTS:
        path = REPOSITORY / name
        files[path] = rendered(path.read_text(encoding="utf-8"), results, second).encode()
    for name, picture in plots(merged(results, second)).items():
        files[REPOSITORY / "docs" / name] = picture.encode()
    return files


def render_all(results: Results, second: Results) -> list[Path]:
    """Write the files whose content differs, and return their paths."""
    written = []
    for path, data in rendered_files(results, second).items():
        if not path.is_file() or path.read_bytes() != data:
            write_bytes(path, data)
            written.append(path)
    return written
