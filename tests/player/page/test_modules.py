"""Tests of the page's modules: what they may be, that all are there, and where they lie."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path

import pytest

from player.errors import FormatError
from player.page.modules import joined
from player.page.page import page_script, web_files


def test_modules_that_break_the_rules() -> None:
    main = {"worker.js": ""}
    with pytest.raises(FormatError, match=r"circle, got main\.js -> a\.js -> main\.js"):
        joined(
            {**main, "main.js": 'import { a } from "./a.js";\n', "a.js": 'import { b } from "./main.js";\n'}
        )
    with pytest.raises(FormatError, match=r"main.js: imports: expected a module, got other.js"):
        joined({**main, "main.js": 'import { a } from "./other.js";\n'})
    for line in ("export default 1;", "import './a.js';", "export { a };", "export let a = 1;"):
        with pytest.raises(FormatError, match="another form of import or export"):
            joined({**main, "main.js": line})


def test_the_package_has_every_module_that_is_imported() -> None:
    files = web_files()
    assert {"main.js", "worker.js", "boot.js", "style.css", "index.html", "shaders.js"} <= set(files)
    assert page_script(files).isascii()


def test_imports_name_files_where_they_lie() -> None:
    """The joined script finds modules by their names alone, but readers and browsers follow the paths."""
    top = Path(str(resources.files("player.page"))) / "web"
    paths = [path for path in top.rglob("*") if path.is_file()]
    assert len({path.name for path in paths}) == len(paths), "two files have one name"
    for path in paths:
        for name in re.findall(r'^import .* from "(.*)";$', path.read_text(), re.MULTILINE):
            imported = (path.parent / name).resolve()
            assert imported.is_file() or imported == top / "shaders.js", (path.name, name)


def test_an_installed_package_has_the_files_of_the_page() -> None:
    """pyproject.toml lists the page's files. It is read as text, because Python 3.10 has no TOML parser."""
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    assert '"player.page" = ["web/*", "web/*/*"]' in text
