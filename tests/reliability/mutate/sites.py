"""Places in a source file where a small change should make a test fail, and the change itself.

A site is an operator, a comparison, a number, the border of a slice or a range, a choice between `min` and
`max`, or the value that a function returns. Text is no site: docstrings, annotations, error messages,
f-strings, decorators, `__all__`. Neither are settings that only change speed.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.GtE), ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
OPERATORS: dict[type, tuple[type, ...]] = {
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div, ast.Add), ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,), ast.Mod: (ast.Add,), ast.Pow: (ast.Mult,), ast.LShift: (ast.RShift,),
    ast.RShift: (ast.LShift,), ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,), ast.BitXor: (ast.BitAnd,),
}  # fmt: skip
SWAPS = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "floor": "ceil",
    "ceil": "floor", "any": "all", "all": "any", "argmin": "argmax", "argmax": "argmin",
}  # fmt: skip
SPEED = {"strict", "cache", "nogil", "parallel", "daemon", "copy", "stacklevel", "chunksize"}
"""Keyword arguments that do not change results."""
TEXT_CALLS = {"progress", "print", "add_argument", "warn"}
"""Calls whose arguments are shown to people."""


@dataclass(frozen=True)
class Site:
    """One change of one file."""

    path: str
    scope: str
    """The function or class around the change; `<module>` outside all of them."""
    line: int
    start: int
    end: int
    """Start and end of the bytes of the source that are replaced."""
    old: str
    new: str
    number: int
    """Number of this site among equal changes in the same scope, from 0."""

    @property
    def name(self) -> str:
        """Return the name of the change in the results. It does not depend on line numbers."""
        again = f" #{self.number}" if self.number else ""
        return f"{self.path}: {self.scope}: {self.old} -> {self.new}{again}"

    def rank(self, seed: int) -> str:
        """Return a random rank by which sites are drawn; changes of other sites do not move it."""
        return hashlib.sha256(f"{seed} {self.name}".encode()).hexdigest()

    def applied(self, source: bytes) -> bytes:
        """Return the source with the change."""
        return source[: self.start] + self.new.encode() + source[self.end :]


def sites_of(path: str, source: bytes) -> list[Site]:
    """Return all sites of a file, in its order."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: list[Site] = []
    counts: dict[tuple[str, str, str], int] = {}
    for scope, node, new in _changes(ast.parse(source)):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        old = " ".join(source[start:end].decode().split())
        key = (scope, old, new)
        number = counts[key] = counts.get(key, -1) + 1
        found.append(Site(path, scope, node.lineno, start, end, old, new, number))
    return found


def _changes(tree: ast.AST, scope: str = "<module>") -> Iterator[tuple[str, ast.expr | ast.stmt, str]]:
    """Yield (scope, node, replacement) for every change below `tree`."""
    for node in _below(tree):
        inner = scope
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            inner = node.name if scope == "<module>" else f"{scope}.{node.name}"
        if isinstance(node, ast.expr | ast.stmt):
            yield from ((inner, target, new) for target, new in _of_node(node))
        yield from _changes(node, inner)


def _below(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the children that are not text."""
    skipped: list[ast.AST | None] = []
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        skipped += [*node.decorator_list, node.returns]
    elif isinstance(node, ast.arg):
        return
    elif isinstance(node, ast.ClassDef):
        skipped += [*node.decorator_list, *node.keywords]
    elif isinstance(node, ast.AnnAssign):
        skipped += [node.annotation]
    elif isinstance(node, ast.If) and _is_for_types_or_main(node.test):
        return
    elif isinstance(node, ast.Call):
        skipped += [keyword for keyword in node.keywords if keyword.arg in SPEED]
    for child in ast.iter_child_nodes(node):
        text = isinstance(child, ast.JoinedStr | ast.Raise | ast.Assert | ast.Import | ast.ImportFrom)
        alias = isinstance(child, ast.Assign) and any(_is_text_name(target) for target in child.targets)
        if not (text or alias or child in skipped or _is_text_call(child)):
            yield child


def _is_for_types_or_main(test: ast.expr) -> bool:
    return any(isinstance(n, ast.Name) and n.id in ("TYPE_CHECKING", "__name__") for n in ast.walk(test))


def _is_text_name(target: ast.expr) -> bool:
    """Return whether a target is `__all__` or an alias of a type, such as `Bounds = tuple[...]`."""
    return isinstance(target, ast.Name) and (
        target.id == "__all__" or (target.id[0].isupper() and not target.id.isupper())
    )


def _is_text_call(node: ast.AST) -> bool:
    if not isinstance(node, ast.Call):
        return False
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name.lstrip("_") in TEXT_CALLS or name.endswith(("Error", "TypeVar"))


def _of_node(node: ast.expr | ast.stmt) -> Iterator[tuple[ast.expr | ast.stmt, str]]:
    """Yield the changes of one node: what is replaced, and its replacement."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        for op in COMPARISONS.get(type(node.ops[0]), ()):
            yield node, _text(ast.Compare(node.left, [op()], node.comparators))
    elif isinstance(node, ast.BinOp) and not (_is_string(node.left) or _is_string(node.right)):
        for op in OPERATORS.get(type(node.op), ()):
            yield node, _text(ast.BinOp(node.left, op(), node.right))
    elif isinstance(node, ast.AugAssign):
        for op in OPERATORS.get(type(node.op), ()):
            yield node, ast.unparse(ast.AugAssign(node.target, op(), node.value))
    elif isinstance(node, ast.BoolOp):
        other = ast.And() if isinstance(node.op, ast.Or) else ast.Or()
        yield node, _text(ast.BoolOp(other, node.values))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub | ast.Invert):
        yield node, _text(node.operand)
    elif isinstance(node, ast.Constant):
        yield from ((node, new) for new in _other_constants(node.value))
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice):
        for border in (node.slice.lower, node.slice.upper):
            if border is not None and not isinstance(border, ast.Constant):
                yield border, f"({ast.unparse(border)} + 1)"
    elif isinstance(node, ast.Call):
        yield from _other_calls(node)
    elif isinstance(node, ast.Return) and node.value is not None:
        truth = isinstance(node.value, ast.Compare | ast.BoolOp)
        yield node.value, f"(not ({ast.unparse(node.value)}))" if truth else "None"


def _other_constants(value: object) -> Iterator[str]:
    if isinstance(value, bool):
        yield repr(not value)
    elif isinstance(value, int):
        yield from (repr(value + 1), repr(value - 1)) if value else ("1",)
    elif isinstance(value, float):
        yield from (repr(value * 2), repr(value / 2)) if value else ("1.0",)


def _other_calls(node: ast.Call) -> Iterator[tuple[ast.expr, str]]:
    function = node.func
    if isinstance(function, ast.Name) and function.id in ("range", "prange"):
        for argument in node.args[:2]:
            if not isinstance(argument, ast.Constant):
                yield argument, f"({ast.unparse(argument)} - 1)"
    if isinstance(function, ast.Name) and function.id in SWAPS:
        yield function, SWAPS[function.id]
    elif isinstance(function, ast.Attribute) and function.attr in SWAPS:
        yield function, ast.unparse(ast.Attribute(function.value, SWAPS[function.attr]))


def _text(node: ast.expr) -> str:
    return f"({ast.unparse(ast.fix_missing_locations(node))})"


def _is_string(node: ast.expr) -> bool:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _is_string(node.left) or _is_string(node.right)
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
