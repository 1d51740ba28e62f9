"""Commands `vfr-train`, `vfr-bake`, `vfr-eval` and `vfr-bench`: settings from the command line, progress bars
on stderr, results on stdout.

Exit codes: 0 done, 1 an error (stated in one message), 2 wrong usage, 130 Ctrl-C, 141 nobody reads the
output.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from player.app.commands import run
from player.errors import MissingExtraError
from vfr_bake.commands.bake import bake_command
from vfr_bake.commands.evaluate import bench_command, eval_command
from vfr_bake.commands.train import train_command


def train_main(argv: Sequence[str] | None = None) -> int:
    """Run `vfr-train`; return the exit code."""
    return run("vfr-train", lambda: train_command(_parse("vfr-train", "Train", argv)))


def bake_main(argv: Sequence[str] | None = None) -> int:
    """Run `vfr-bake`; return the exit code."""
    return run("vfr-bake", lambda: bake_command(_parse("vfr-bake", "Bake", argv)))


def eval_main(argv: Sequence[str] | None = None) -> int:
    """Run `vfr-eval`; return the exit code."""
    return run("vfr-eval", lambda: eval_command(_parse("vfr-eval", "Eval", argv)))


def bench_main(argv: Sequence[str] | None = None) -> int:
    """Run `vfr-bench`; return the exit code."""
    return run("vfr-bench", lambda: bench_command(_parse("vfr-bench", "Bench", argv)))


def _parse(name: str, options: str, argv: Sequence[str] | None) -> Any:
    for package in ("torch", "numba", "tyro"):
        if find_spec(package) is None:
            raise MissingExtraError(
                f"{package} is not installed: training and baking need: pip install 'vfr-bake[train]'"
            )
    import tyro

    from vfr_bake import options as classes
    from vfr_bake.option_types import described, registry

    conf = tyro.conf
    config = (conf.OmitArgPrefixes, conf.FlagCreatePairsOff, conf.PositionalMetavarFromFieldName)
    with registry():
        return tyro.cli(described(getattr(classes, options)), prog=name, args=argv, config=config)
