"""Starting another Python process so that it takes no code from the current folder.

An interpreter that is started with `-c` or `-m` looks for every module in the current folder first: a
`json.py` there, in an asset that was downloaded, would be executed. Every process is started with this.
"""

from __future__ import annotations

import sys
from pathlib import Path

_PROGRAM = (
    "import sys; sys.path[:] = {path}; import runpy; runpy.run_module({module}, None, '__main__', True)"
)


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module as a program of its own, on the modules that this process has.

    With `-I` the interpreter looks neither at the current folder nor at PYTHONPATH nor at the user's own
    packages while it starts (`-P` heeds PYTHONPATH, and is not in Python 3.10). What this process looks at is
    handed on before anything else is imported, so that a source checkout, an installation for one user and
    what the caller added are found all the same: the absolute entries of its path, never "" or another
    relative one. The folder that holds these packages comes last, in case it was found by such an entry.
    Other PYTHON* variables do not reach the child.

    Args:
        module: its full name; it runs as `__main__`.
        arguments: its `sys.argv[1:]`.

    >>> python_command("exporters.mesh.unwrap", "folder")[1:3]
    ['-I', '-c']
    """
    path = [place for place in sys.path if Path(place).is_absolute()]
    path.append(str(Path(__file__).resolve().parent.parent))
    return [sys.executable, "-I", "-c", _PROGRAM.format(path=ascii(path), module=ascii(module)), *arguments]
