"""The JavaScript modules of the page, joined into one script.

A web page that is opened from a disk may not load modules from files. So the modules of `player/page/web` use
only a small part of the language, so that they can be joined line by line, without a parser:

- an import begins a line and reads `import { a, b as c } from "./name.js";` or `from "../folder/name.js";`;
  no two files have the same name, so only browsers that load modules one by one need the folder;
- an export begins a line and is `export` before `function`, `async function`, `class` or `const` and a name;
- imports have no circle, and nothing awaits outside of a function.

Each module becomes a function that returns its exports, and that is called when the module is first asked
for. So names that a module does not export stay its own, and one script can begin with either of two modules:
the page's `main.js`, or `worker.js` in a worker that is made from the same text.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from player.errors import FormatError

_IMPORT = re.compile(r'^import \{([^}]*)\} from "\.{1,2}/(?:\w+/)?([\w.-]+)";\n?', re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async function\*?|function\*?|class|const) (\w+))", re.MULTILINE)
_OTHER = re.compile(r"^(import|export)\b.*", re.MULTILINE)

_BEGIN = """"use strict";
{
const modules = {}, loaded = {};
const load = (name) => (loaded[name] ??= modules[name]());
"""


def joined(sources: Mapping[str, str], page: str = "main.js", worker: str = "worker.js") -> str:
    """Join the modules that `page` and `worker` need to one script.

    Args:
        sources: the text of each module, by its file's name.
        page: the module that runs in a page.
        worker: the module that runs in a worker.

    Raises:
        FormatError: a module is missing, imports have a circle, or an import or export has another form.

    >>> sources = {"main.js": 'import { two as b } from "./two.js";\\nconsole.log(b);\\n',
    ...            "two.js": "export const two = 2;\\n", "worker.js": "postMessage(1);\\n"}
    >>> print(joined(sources).split(";\\n", 3)[3])
    modules["two.js"] = () => {
    const two = 2;
    return { two };
    };
    modules["main.js"] = () => {
    const { two: b } = load("two.js");
    console.log(b);
    return {  };
    };
    modules["worker.js"] = () => {
    postMessage(1);
    return {  };
    };
    load(globalThis.document ? "main.js" : "worker.js");
    }
    <BLANKLINE>
    """
    order = _order(sources, (page, worker))
    functions = [f'modules["{name}"] = () => {{\n{_as_function(sources[name], name)}}};\n' for name in order]
    start = f'load(globalThis.document ? "{page}" : "{worker}");\n}}\n'
    return _BEGIN + "".join(functions) + start


def _order(sources: Mapping[str, str], entries: tuple[str, ...]) -> list[str]:
    """List the modules that the entries need, each after those that it imports."""
    order: list[str] = []

    def visit(name: str, path: tuple[str, ...]) -> None:
        if name in path:
            raise FormatError(f"{name}: imports: expected no circle, got {' -> '.join((*path, name))}")
        if name not in sources:
            raise FormatError(f"{(path or ('page',))[-1]}: imports: expected a module, got {name}")
        if name not in order:
            for match in _IMPORT.finditer(sources[name]):
                visit(match[2], (*path, name))
            order.append(name)

    for entry in entries:
        visit(entry, ())
    return order


def _as_function(source: str, name: str) -> str:
    """Turn a module's text into the body of a function that returns the module's exports."""
    exported = [match[2] for match in _EXPORT.finditer(source)]

    def import_line(match: re.Match[str]) -> str:
        names = ", ".join(part.strip().replace(" as ", ": ") for part in match[1].split(",") if part.strip())
        return f'const {{ {names} }} = load("{match[2]}");\n'

    body = _EXPORT.sub(r"\1", _IMPORT.sub(import_line, source))
    other = _OTHER.search(body)
    if other is not None:
        raise FormatError(f"{name}: expected another form of import or export, got {other[0]}")
    return f"{body.rstrip()}\nreturn {{ {', '.join(exported)} }};\n"


def without_comments(source: str) -> str:
    """Return a module or a shader without comments, indents and empty lines.

    Comments are `// ...` lines, ` // ...` at the end of a line if no quote is in it, and `/* ... */` that
    begins and ends lines of its own. A template or string of several lines keeps its content only if none of
    its lines looks like a comment.

    >>> without_comments("// What it is.\\nconst a = 1; // one\\n\\n  /* more\\n  text */\\n  f(a);\\n")
    'const a = 1;\\nf(a);\\n'
    """
    source = re.sub(r"^[ \t]*/\*.*?\*/[ \t]*$", "", source, flags=re.MULTILINE | re.DOTALL)
    lines = (re.sub(r"\s// [^\"'`]*$", "", line).strip() for line in source.splitlines())
    return "".join(f"{line}\n" for line in lines if line and not line.startswith("//"))
