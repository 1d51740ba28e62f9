"""Commands for other Python processes that take no code from the current folder.

An interpreter that is started with `-c` or `-m` looks for every module in the current folder first: a
`json.py` there, in an asset that was downloaded, would be executed. Every process is therefore started with
`python_command`.
"""

from __future__ import annotations

import sys
from pathlib import Path

_PROGRAM = (
    "import sys; sys.path[:] = {path}; import runpy; runpy.run_module({module}, None, '__main__', True)"
)


def python_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module as a program of its own, with the same modules as this process.

    With `-I`, the interpreter ignores the current folder, PYTHONPATH and the user's own packages while it
    starts (`-P` respects PYTHONPATH, and is not in Python 3.10). The child's path is set before it imports
    anything else: it gets the absolute entries of this process's path, never "" or another relative entry. So
    a source checkout, an installation for one user and what the caller added are still found. The folder that
    holds these packages is added last, in case it was found by a relative entry. Other PYTHON* variables do
    not reach the child.

    Args:
        module: the full name of the module; it runs as `__main__`.
        arguments: the module's `sys.argv[1:]`.

    >>> python_command("exporters.mesh.unwrap", "folder")[1:3]
    ['-I', '-c']
    """
    path = [place for place in sys.path if Path(place).is_absolute()]
    path.append(str(Path(__file__).resolve().parent.parent))
    return [sys.executable, "-I", "-c", _PROGRAM.format(path=ascii(path), module=ascii(module)), *arguments]
