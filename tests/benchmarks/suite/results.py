"""The file of results: for each part its figures, and the conditions under which they were found."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from player.files.files import write_bytes
from tests.benchmarks.suite.conditions import REPOSITORY

RESULTS = REPOSITORY / "docs" / "benchmarks.json"
RESULTS_AVX512 = REPOSITORY / "docs" / "benchmarks_avx512.json"
"""Files of results, beside the pages that are rendered from them, so that the source package has all of them.
The first is of processors without AVX-512, which most people have; the second is of processors with it."""
KEYS = {
    *("commit", "date", "machine", "load_before", "load_after", "others_before", "others", "libraries"),
    *("seeds", "commands", "seconds", "figures"),
}
"""Keys that are kept of a part. `others_before` and `others` are the shares of all processors that other
programs took before the part and during it."""

Results = dict[str, dict[str, Any]]


def results_path(machine: dict[str, Any]) -> Path:
    """Return the file for results of such a machine.

    >>> results_path({"features": ["avx2", "avx512f"]}).name, results_path({"features": ["avx2"]}).name
    ('benchmarks_avx512.json', 'benchmarks.json')
    """
    return RESULTS_AVX512 if "avx512f" in machine["features"] else RESULTS


def read_results(path: Path = RESULTS) -> Results:
    """Return the parts of a file by name, none if there is no file. Raises ValueError for other content."""
    if not path.exists():
        return {}
    document = json.loads(path.read_text(encoding="utf-8"))
    parts = document["parts"]
    for name, part in parts.items():
        if set(part) != KEYS:
            raise ValueError(f"{path.name}: {name}: expected the keys {sorted(KEYS)}, got {sorted(part)}")
    return parts


def write_results(parts: Results, order: list[str], path: Path = RESULTS) -> None:
    """Write the parts in this order, with numbers rounded to six digits, without those not in `order`."""
    kept = {name: _rounded(parts[name]) for name in order if name in parts}
    text = json.dumps({"parts": kept}, indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def _rounded(value: Any) -> Any:
    """Return a value with its numbers rounded to six digits, and None for numbers that are not finite.

    >>> _rounded({"psnr": [32.23456789, 3], "ssim": float("inf")})
    {'psnr': [32.2346, 3], 'ssim': None}
    """
    if isinstance(value, dict):
        return {key: _rounded(some) for key, some in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(some) for some in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
