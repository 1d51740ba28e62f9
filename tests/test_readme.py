"""The commands in the README work, in their order, and print what it says; its picture is there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from exporters.cli import main as export
from player.app import cli
from player.app.cli import main as play
from player.app.option_types import DEMO
from player.viewer import server
from vfr_bake.cli import bake_main, bench_main, eval_main, train_main

REPOSITORY = Path(__file__).resolve().parent.parent
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")

# Main functions of the README's commands, each with options that make it small enough for a test.
COMMANDS: dict[str, tuple[Callable[[list[str]], int], list[str]]] = {
    "vfr-train": (
        train_main,
        [
            *("--steps", "150", "--n-levels", "6", "--max-resolution", "48", "--log2-table-size", "13"),
            *("--head-width", "24", "--occupancy-resolution", "32", "--batch-samples", "4096"),
        ],
    ),
    "vfr-bake": (bake_main, ["--mesh-resolution", "32", "--check-views", "1", "--refine-steps", "50"]),
    "vfr-eval": (eval_main, []),
    "vfr-play": (play, ["--size", "24x24"]),
    "vfr-bench": (bench_main, ["--views", "1", "--frames", "2", "--sizes", "24x24", "--samples", "1", "5"]),
    "vfr-export": (export, []),
}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_commands_and_the_python_run(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    seen = set()
    (commands,) = (block for block in blocks("bash") if "DATA" in block)
    for line in commands.splitlines():
        words = [
            {"DATA": str(small_data), "transforms_test.json": str(small_data / "transforms_test.json")}.get(
                word, word
            )
            for word in shlex.split(line, comments=True)
        ]
        main, smaller = COMMANDS[words[0]]
        if words == ["vfr-play", "out/"]:  # serves until Ctrl-C: tests/player/viewer/test_viewer.py
            continue
        assert main(words[1:] + (smaller if "--info" not in words else [])) == 0, line
        seen.add(words[0])
    assert seen == set(COMMANDS)
    assert len(list(Path("frames").glob("*.png"))) == 60
    for code in blocks("python"):
        exec(compile(code, "README.md", "exec"), {})


def test_the_first_command_prints_what_the_readme_shows(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The viewer is replaced by one that is ready at once and is interrupted."""

    @contextmanager
    def serve(*_: Any) -> Iterator[str]:
        yield "http://127.0.0.1:8080"

    def interrupted(seconds: float) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(server, "serve", serve)
    monkeypatch.setattr(cli, "find_spec", lambda name: True)  # whether viser is installed or not
    monkeypatch.setattr(cli, "threading", SimpleNamespace(Event=lambda: SimpleNamespace(wait=interrupted)))
    assert play(["demo"]) == 130
    said = capsys.readouterr()
    text = README.split("## Try it")[1].split("![")[0]
    shown = re.findall(r"^    (?!make |python3 |pip |vfr-play demo)(.*)$", text, re.MULTILINE)
    folder = str(DEMO.parents[2])
    printed = [*said.out.splitlines(), *said.err.splitlines()]
    assert [line.replace(folder, "...").replace("\\", "/") for line in printed] == [
        *shown,
        "vfr-play: interrupted",
    ]


def test_make_targets_of_the_readme_exist() -> None:
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    targets = re.findall(r"^    make (\w+)", README, re.MULTILINE)
    assert targets == ["demo", "test"]
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


def test_pictures_and_files_that_it_names_are_there() -> None:
    for target in re.findall(r"\]\((?!http)([^)]+)\)", README):
        assert (REPOSITORY / target).is_file(), target


def test_version_is_the_same_everywhere() -> None:
    from player.asset.manifest import VERSION
    from vfr_bake import __version__
    from vfr_bake.training.model_file import VERSION as MODEL_VERSION

    project = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    assert f'version = "{__version__}"' in project
    changelog = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## {__version__}" in changelog
    asset, model = (".".join(map(str, version)) for version in (VERSION, MODEL_VERSION))
    assert f"asset {asset} ([docs/format.md](docs/format.md)), model {model}." in changelog
    citation = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {__version__}\n" in citation
