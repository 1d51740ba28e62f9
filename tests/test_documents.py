"""Links, commands, Python code, quoted messages and names in the manual and other documents are right."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import markdown
import numpy as np
import pytest
import yaml

from exporters import cli as exporters_cli
from exporters.formats.ply import ply_bytes
from exporters.options import check_options
from player import Asset
from player.app.option_types import joined_negatives
from player.app.options import parse as parse_play
from player.asset.asset import GridArrays, write_asset
from player.asset.manifest import FILES, Manifest
from player.cameras.transforms import write_cameras
from player.cameras.views import read_views
from player.child import python_command
from player.render import render
from tests.exporters.meshes import box
from vfr_bake.baking.convert import with_coarser_levels
from vfr_bake.cli import _parse as parse_tyro

REPOSITORY = Path(__file__).resolve().parent.parent
DOCS = REPOSITORY / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
DOCUMENTS = sorted([*(f"docs/{page}" for page in PAGES), "README.md", "CHANGELOG.md", "CONTRIBUTING.md"])
MANUAL = [document for document in DOCUMENTS if not document.startswith("docs/notes/")]
"""Documents that describe the present; a note describes one day's measurement and is not changed later."""
USER_PAGES = (
    *("index", "install", "photographing", "train", "bake", "play", "page", "export", "python"),
    *("conventions", "format", "troubleshooting", "trade", "benchmarks"),
)
OF_ANOTHER_TIME = (
    *(
        "before this",
        "before that,",
        "beside tests",
        "beside a bake",
        "another day",
        "other days",
        "today's session",
    ),
    *("(before)", "(now)", "mended", "used to ", "no longer", "the time before", "at the time of writing"),
)
"""Phrases of a diary: earlier states, and the circumstances of a measurement, belong in the notes."""


def read(document: str) -> str:
    return (REPOSITORY / document).read_text(encoding="utf-8")


# Links --------------------------------------------------------------------------------------------


class _Html(HTMLParser):
    """The targets of links and pictures, the ids, and the texts of code outside and inside blocks."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.ids: set[str] = set()
        self.code: list[str] = []
        self.blocks: list[tuple[str, str]] = []
        self._open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = dict(attrs)
        self.targets += [target for key in ("href", "src") if (target := known.get(key))]
        self.ids |= {known["id"] or ""} if "id" in known else set()
        if tag in ("pre", "code"):
            self._open.append(tag)
            if tag == "code":
                text = ("", (known.get("class") or "").removeprefix("language-"))
                self.blocks.append(text[::-1]) if "pre" in self._open else self.code.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("pre", "code"):
            self._open.pop()

    def handle_data(self, data: str) -> None:
        if self._open == ["pre", "code"]:
            language, text = self.blocks[-1]
            self.blocks[-1] = (language, text + data)
        elif self._open == ["code"]:
            self.code[-1] += data


@cache
def parsed(document: str) -> _Html:
    """Return a document as MkDocs sees it."""
    html = _Html()
    html.feed(markdown.markdown(read(document), extensions=["toc", "tables", "fenced_code"]))
    return html


def broken_links(document: str, targets: list[str]) -> Iterator[str]:
    for target in targets:
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = unquote(target).partition("#")
        path = ((REPOSITORY / document).parent / name).resolve() if name else REPOSITORY / document
        if not path.exists():
            yield f"{target}: no such file"
        elif anchor and (
            path.suffix != ".md" or anchor not in parsed(path.relative_to(REPOSITORY).as_posix()).ids
        ):
            yield f"{target}: no such heading"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(document: str) -> None:
    assert list(broken_links(document, parsed(document).targets)) == []


def test_a_broken_link_is_found() -> None:
    targets = ["bake.md", "bake.md#no-such-heading", "no-such-page.md", "#a-first-run", "https://example.org"]
    assert [found.split(":")[0] for found in broken_links("docs/bake.md", targets)] == targets[1:3]


# The site -----------------------------------------------------------------------------------------


def _files_of(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [name for item in (nav.values() if isinstance(nav, dict) else nav) for name in _files_of(item)]


def test_the_navigation_has_every_page_once() -> None:
    nav = yaml.safe_load(read("mkdocs.yml"))["nav"]
    assert sorted(_files_of(nav)) == PAGES
    assert {f"{name}.md" for name in USER_PAGES} == {"index.md", *_files_of(nav[1])}


def test_notes_are_dated_listed_and_linked_from_where_they_are_used() -> None:
    notes = [page for page in PAGES if page.startswith("notes/") and page != "notes/index.md"]
    listed = parsed("docs/notes/index.md").targets
    for note in notes:
        assert re.fullmatch(r"notes/20\d\d-[01]\d-[0-3]\d-[a-z0-9-]+\.md", note), note
        assert Path(note).name in listed, note
        users = [
            page for page in PAGES if any(t.split("#")[0] == note for t in parsed(f"docs/{page}").targets)
        ]
        assert users, f"{note}: linked from no page"


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    site = tmp_path / "site"
    done = subprocess.run(
        python_command("mkdocs", "build", "--strict", "--quiet", "--site-dir", str(site)),
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    assert {path.relative_to(site).with_suffix(".md").as_posix() for path in site.rglob("*.html")} >= set(
        PAGES
    )
    source = (site / "source/player/render.py.txt").read_bytes()
    assert source == (REPOSITORY / "player/render.py").read_bytes()


# Commands -----------------------------------------------------------------------------------------


def _export(words: list[str]) -> None:
    arguments = exporters_cli.make_parser().parse_args(joined_negatives(words, "--crop", "--views"))
    check_options(arguments.file, exporters_cli._options(arguments))


PARSERS: dict[str, Callable[[list[str]], object]] = {
    "vfr-train": lambda words: parse_tyro("vfr-train", "Train", words),
    "vfr-bake": lambda words: parse_tyro("vfr-bake", "Bake", words),
    "vfr-eval": lambda words: parse_tyro("vfr-eval", "Eval", words),
    "vfr-bench": lambda words: parse_tyro("vfr-bench", "Bench", words),
    "vfr-play": parse_play,
    "vfr-export": _export,
}
OTHER_COMMANDS = ("python3 -m venv", ". .venv/bin/activate")


def check_line(line: str) -> None:
    """Raise unless a shell line is a command that this repository understands."""
    words = shlex.split(line, comments=True)
    if words[0] in PARSERS:
        PARSERS[words[0]](words[1:])
    elif words[0] == "make":
        for target in words[1:]:
            assert re.search(rf"^{target}:", read("Makefile"), re.MULTILINE), f"{line}: no such target"
    elif words[0] == "python":
        path = Path(words[2].replace(".", "/") if words[1] == "-m" else words[1])
        script = next(
            (found for found in (path, path.with_suffix(".py"), path / "__main__.py")
             if (REPOSITORY / found).is_file()),
            None,
        )  # fmt: skip
        assert script is not None, f"{line}: no such script"
        for option in (word for word in words if word.startswith("--")):
            assert f'"{option}"' in read(script.as_posix()), f"{line}: {option}: no such option"
    elif words[:2] == ["pip", "install"]:
        for extra in re.findall(r"[\w-]+", "".join(re.findall(r"\[(.*?)\]", words[2]))):
            assert re.search(rf"^{extra} = \[", read("pyproject.toml"), re.MULTILINE), (
                f"{line}: no such extra"
            )
    else:
        assert line.startswith(OTHER_COMMANDS), f"{line}: what is this?"


def shell_lines(document: str) -> list[str]:
    """Return a document's commands: lines of its shell blocks, and lines of others that call one of ours."""
    lines = []
    for language, text in parsed(document).blocks:
        for line in text.splitlines():
            ours = re.match(r"(vfr-[a-z]+ (?!error)[^:]*|make [a-z-]+|python .*)$", line)
            if (language == "bash" or ours) and line.strip() and not line.lstrip().startswith("#"):
                lines.append(line)
    return lines


@pytest.mark.parametrize("document", MANUAL)
def test_commands_parse(document: str) -> None:
    for line in shell_lines(document):
        try:
            check_line(line)
        except SystemExit:
            pytest.fail(f"{document}: {line}")


def test_commands_are_found() -> None:
    found = [line.split()[0] for document in MANUAL for line in shell_lines(document)]
    assert set(PARSERS) <= set(found) and len(found) > 70


@pytest.mark.parametrize(
    "line",
    [
        "vfr-train DATA model.pt --minute 2",
        "vfr-train DATA model.pt --kind indoor",
        "vfr-bake model.pt",
        "vfr-bake model.pt out/ --preset best",
        "vfr-eval model.pt DATA --k 3",
        "vfr-bench out/ --html trade.html",
        "vfr-play out/ --fetches 4",
        "vfr-play out/ --frames 1:2",
        "vfr-export out/ mesh.glb --frame unity",
        "vfr-export out/ mesh.stl --decode",
        "vfr-export out/ mesh.gltf",
        "make cofee",
        "pip install '.[gpu]'",
        "python tests/benchmarks/bench_play.py out/ --curve",
        "python -m tests.reliability.nothing",
        "vfr-view out/",
    ],
)
def test_a_wrong_command_is_found(line: str) -> None:
    with pytest.raises((SystemExit, ValueError, AssertionError)):
        check_line(line)


def _help_of(command: str) -> str:
    from contextlib import redirect_stdout, suppress
    from io import StringIO

    out = StringIO()
    with redirect_stdout(out), suppress(SystemExit):
        if command == "vfr-export":
            exporters_cli.make_parser().parse_args(["--help"])
        else:
            PARSERS[command](["--help"])
    return out.getvalue()


def _options_of(command: str) -> set[str]:
    return set(re.findall(r"--[a-z][a-z0-9-]+", _help_of(command)))


@pytest.mark.parametrize("command", PARSERS)
def test_the_help_has_examples_that_parse(command: str) -> None:
    """The help shows at least two example commands, each followed by two spaces or the line's end."""
    found = re.findall(rf"^  ({command} .+?)(?:  |$)", _help_of(command), re.MULTILINE)
    assert len(found) >= 2
    for line in found:
        check_line(line)


@pytest.mark.parametrize("command", PARSERS)
def test_the_help_has_no_word_of_python(command: str) -> None:
    text = _help_of(command)
    assert not re.search(r"\bNone\b|\bFalse\b|\(default: *\)", text)


def test_options_in_sentences_exist() -> None:
    known = {command: _options_of(command) for command in PARSERS}
    every = set().union(*known.values())
    others = {"--nproc-per-node", "--no-deps", "--index-url"}  # options of torchrun and pip
    wrong = []
    for document in MANUAL:
        for text in parsed(document).code:
            command = next((name for name in PARSERS if text.startswith(f"{name} ")), None)
            of_a_script = text.startswith(("python ", "pytest "))
            if of_a_script and "--" in text:
                check_line(text)
                continue
            for option in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]+", text):
                if option not in (known[command] if command else every | others):
                    wrong.append(f"{document}: {text}: {option}")
    assert wrong == []


def test_targets_and_extras_in_sentences_exist() -> None:
    for document in MANUAL:
        for text in parsed(document).code:
            if re.match(r"(make [a-z]|pip install '\.)", text) and "[NAME]" not in text:
                check_line(re.sub(r" [A-Z]+=\S+", "", text))


def test_the_table_of_extras_has_them_all() -> None:
    extras = re.findall(r"^(\w+) = \[", read("pyproject.toml").split("[project.optional-dependencies]")[1]
                        .split("[project.scripts]")[0], re.MULTILINE)  # fmt: skip
    table = re.findall(r"^\| `(\w+)` \|", read("docs/install.md"), re.MULTILINE)
    assert sorted(table) == sorted(set(extras) - {"release"})


# Python -------------------------------------------------------------------------------------------


def python_blocks(document: str) -> list[str]:
    return [text for language, text in parsed(document).blocks if language == "python"]


RUN = {"docs/python.md", "docs/conventions.md", "docs/export.md", "docs/format.md", "docs/page.md"}


def test_every_page_with_python_is_run() -> None:
    assert {document for document in MANUAL if python_blocks(document)} == RUN | {"README.md"}


@pytest.mark.parametrize("document", sorted(RUN))
def test_python_runs(
    document: str, shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _write_as_baked(shells_folder)
    if document == "docs/export.md":
        assert exporters_cli.main(["out", "scene.npz"]) == 0
    names: dict[str, Any] = {"__name__": "page"}
    for number, code in enumerate(python_blocks(document)):
        exec(compile(code, f"{document}, block {number}", "exec"), names)
    if document == "docs/format.md":
        _compare_pixels(names)


def _write_as_baked(shells_folder: Path) -> None:
    """Write the small asset of the tests to "out", with the cameras and the provenance that a bake writes."""
    asset = Asset.open(shells_folder)
    manifest = replace(asset.manifest, provenance={"bake": {"preset": "balanced"}})
    size = (manifest.view_size[0], manifest.view_size[1])
    cameras = write_cameras(read_views(shells_folder / "cameras.json", size))
    mesh = ply_bytes(box((1.25, 2.25, 3.0), (1.75, 2.5, 4.0)))
    arrays = GridArrays(
        with_coarser_levels(asset.arrays.densities, "densities"),
        with_coarser_levels(asset.arrays.features, "features"),
    )
    steps = (1,) * len(arrays.densities.values)  # the features have as many levels
    manifest = replace(manifest, parts=(), level_steps=steps, density_steps=steps, feature_steps=steps)
    write_asset(Path("out"), manifest, arrays, asset.read("head.onnx"), mesh, cameras)


def _compare_pixels(names: dict[str, Any]) -> None:
    """Compare the reader in docs/format.md with the player, on some pixels with matter and one without."""
    asset, camera = Asset.open("out"), read_views("out/cameras.json")[0]
    frame = render(asset, camera)
    for grid in ("densities", "features"):
        stored = getattr(asset.arrays, grid)
        assert len(names[grid]) == len(stored.values) > 1
        for level, vertices, values in zip(names[grid], stored.pyramid.vertices, stored.values, strict=True):
            assert np.array_equal(level.vertices, vertices.index)
            assert np.array_equal([level.values[vertex] for vertex in level.vertices], values)
    rays_d = camera.rays()[1].reshape(camera.height, camera.width, 3)
    to_model = np.linalg.inv(asset.world_from_model)
    shown = np.argwhere(frame.opacity > 0.05)
    for row, column in [*shown[:: max(len(shown) // 12, 1)], np.argwhere(frame.opacity == 0)[0]]:
        d = to_model[:3, :3] @ rays_d[row, column].astype(np.float64)
        rgb = names["pixel"]((to_model @ camera.c2w)[:3, 3], d / np.linalg.norm(d))
        # The reader computes in float64, the player in float32: a sample near a bin's edge or a cell's face
        # may fall to the other side.
        assert np.abs(rgb - frame.rgb[row, column]).max() < 2e-3, (row, column)


def test_the_format_names_every_key_and_file() -> None:
    text = read("docs/format.md")
    keys = text.split("## manifest.json")[1].split("**Versions.**")[0]
    fields = set(Manifest.__dataclass_fields__)
    assert set(re.findall(r"^\| `(\w+)` \|", keys, re.MULTILINE)) == fields | {"format"}
    files = text.split("## manifest.json")[0]
    named = set(re.findall(r"`([\w.]+\.\w+)`", "".join(re.findall(r"^\| `.*?` \|", files, re.MULTILINE))))
    reports = {"report.json", "report.html"}
    assert set(FILES) | {"manifest.json"} <= named <= set(FILES) | {"manifest.json"} | reports


# Words --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", USER_PAGES)
def test_user_pages_speak_of_today(name: str) -> None:
    text = " ".join(read(f"docs/{name}.md").lower().split())
    assert [phrase for phrase in OF_ANOTHER_TIME if phrase in text] == []


def _text(node: ast.expr) -> str:
    """Return the text of a string expression, with `...` for the parts that are filled in."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else "..."
    if isinstance(node, ast.JoinedStr):
        return "".join(map(_text, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + _text(node.right)
    return "..."


def _plain(text: str) -> str:
    return re.sub(r"(\.\.\.)+", "...", " ".join(text.split()))


def _messages() -> str:
    """Return every string in the source, one on each line."""
    found = []
    for package in ("player", "exporters", "vfr_bake"):
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr | ast.BinOp | ast.Constant):
                    found.append(_plain(_text(node)))
    return "\n".join(found)


def quoted_messages() -> list[str]:
    """Return the messages quoted in the first cells of troubleshooting's tables, not options or commands."""
    cells = re.findall(r"^\| (.*?) \|", read("docs/troubleshooting.md"), re.MULTILINE)
    quoted = [text for cell in cells for text in re.findall(r"`([^`]+)`", cell)]
    return [
        text for text in quoted if " " in text and not text.startswith(("pip ", "vfr-", "--kind", "--march"))
    ]


def test_messages_of_troubleshooting_are_those_of_the_source() -> None:
    texts, quoted = _messages(), quoted_messages()
    assert len(quoted) > 40
    others = {"no matches found", "No space left on device"}  # messages of zsh and of the system
    assert [text for text in quoted if _plain(text).strip(". ") not in texts and text not in others] == []


def test_tests_that_are_named_exist() -> None:
    paths = [*(REPOSITORY / "tests").rglob("*.py"), *(REPOSITORY / "tests").rglob("*.json")]
    sources = {path.name for path in paths}
    functions = {
        name
        for path in paths
        for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    for document in MANUAL:
        for text in parsed(document).code:
            if match := re.fullmatch(r"(?:[\w/]+/)?(test_\w+\.py)", text):
                assert match[1] in sources, f"{document}: {text}"
            elif match := re.fullmatch(r"(test_\w+?)(\.\.\.)?", text):
                begins = [name for name in functions if name.startswith(match[1])]
                assert begins if match[2] else match[1] in functions, f"{document}: {text}"


def test_paths_that_are_named_exist() -> None:
    for document in MANUAL:
        for text in parsed(document).code:
            if re.fullmatch(r"(player|exporters|vfr_bake|tests|docs|examples)(/\w[\w.-]*)+/?", text):
                assert (REPOSITORY / text).exists(), f"{document}: {text}"


def test_sources_name_pages_that_exist() -> None:
    for folder in ("player", "exporters", "vfr_bake", "tests", "examples"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            for page in re.findall(r"docs/[\w/-]+\.md", path.read_text(encoding="utf-8")):
                assert (REPOSITORY / page).is_file(), f"{path.relative_to(REPOSITORY)}: {page}"
