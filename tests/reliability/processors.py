"""Runs the tests of compiled code again, with the code compiled for other processors than this machine's.

    python -m tests.reliability.processors

Code for a processor with fewer instructions runs here too, so that a new machine finds the faults of others:
x86-64-v2 has registers of four numbers and no fused multiply-add (Intel's of 2009), x86-64-v3 has eight
numbers and no products of bytes (of 2013). NUMBA_CPU_NAME and NUMBA_CPU_FEATURES tell numba the processor,
and the code that it compiles is kept in a folder of its own.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from llvmlite import binding

REPOSITORY = Path(__file__).resolve().parent.parent.parent
NEEDS = {"x86-64-v2": ("sse4.2", "popcnt", "ssse3"), "x86-64-v3": ("avx2", "fma", "bmi2")}
"""Features that this machine must have to run code for each processor."""
BEYOND = {"x86-64-v2": ("avx2",), "x86-64-v3": ("avx512f", "avxvnni")}
"""Features of which this machine must have one, or else the code for a processor is as good as its own."""
TESTS = (
    *(
        "tests/player/compiled/test_lanes.py",
        "tests/player/march/test_march.py",
        "tests/player/march/test_contracted_march.py",
    ),
    *(
        "tests/player/head/test_head_compiled.py",
        "tests/player/test_scratch.py",
        "tests/player/test_render.py",
    ),
    *("tests/numerics", "tests/vfr_bake/field", "tests/vfr_bake/rendering"),
    "tests/vfr_bake/baking/test_stored_features.py",
)
"""All tests that call compiled code."""
SHORT = TESTS[:5]
"""Tests that call the vector functions written for particular processors; half a minute."""


def processors() -> list[str]:
    """Return the lesser processors whose code this machine can run."""
    here = binding.get_host_cpu_features()
    return [
        name
        for name, needs in NEEDS.items()
        if all(here.get(feature) for feature in needs) and any(here.get(more) for more in BEYOND[name])
    ]


def environment_of(name: str, cache: str) -> dict[str, str]:
    """Return the environment in which numba compiles for processor `name`, keeping code in `cache`."""
    settings = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": cache}
    return dict(os.environ) | settings


def run(name: str, tests: tuple[str, ...], cache: str) -> subprocess.CompletedProcess[str]:
    """Run tests, with code that is not in `cache` yet compiled for the processor `name`."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
    environment = environment_of(name, cache)
    return subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "tests", nargs="*", default=TESTS, help="files of tests, all of compiled code if none"
    )
    tests = tuple(parser.parse_args().tests)
    failed = 0
    for name in processors():
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as cache:
            done = run(name, tests, cache)
        failed += done.returncode != 0
        last = (done.stdout.strip().splitlines() or ["no output"])[-1]
        sys.stdout.write(
            f"{name}: exit code {done.returncode}, {time.perf_counter() - begin:.0f} s: {last}\n"
        )
        if done.returncode:
            sys.stdout.write(done.stdout + done.stderr)
        sys.stdout.flush()
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
