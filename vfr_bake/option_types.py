"""Command-line options as `tyro` makes them: how `--help` describes them, and errors for numbers that say
what is expected."""

from __future__ import annotations

from argparse import ArgumentTypeError
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from player.app.option_types import number, whole

_READERS = {int: ("INT", whole()), float: ("FLOAT", number("", "2.5"))}
_METAVARS = {str: "NAME", float: "FLOAT"}


def registry() -> Any:
    """Return tyro's rules, with one more for options that are numbers, of the type `int`, `float | None`,
    `int | Literal["auto"]` or `tuple[int, ...]`."""
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

    rules = ConstructorRegistry()

    @rules.primitive_rule
    def _(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        several = get_origin(info.type) is tuple and get_args(info.type) == (int, ...)
        found = (int, ()) if several else _parts(info.type)
        if found is None:
            return None
        kind, words = found
        metavar, read = _READERS[kind]

        def value_of(text: str) -> Any:
            if text in words:
                return text
            try:
                return read(text)
            except ArgumentTypeError as error:
                expected = str(error).replace("expected ", f"expected {' or '.join((*words, ''))}", 1)
                raise ValueError(expected) from None

        if several:
            return PrimitiveConstructorSpec(
                nargs="*",
                metavar=f"[{metavar} [{metavar} ...]]",
                instance_from_str=lambda texts: tuple(map(value_of, texts)),
                is_instance=lambda value: isinstance(value, tuple),
                str_from_instance=lambda value: [*map(str, value)],
            )
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="|".join((metavar, *words)),
            instance_from_str=lambda texts: value_of(texts[0]),
            is_instance=lambda value: value is None or value in words or type(value) in (int, kind),
            str_from_instance=lambda value: [str(value)],
        )

    return rules


def _parts(kind: Any) -> tuple[type, tuple[str, ...]] | None:
    """Return the type of number and the words that an annotation allows; None if it is not for a number.

    >>> _parts(int), _parts(float | None), _parts(int | Literal["auto"]), _parts(str | None), _parts(bool)
    ((<class 'int'>, ()), (<class 'float'>, ()), (<class 'int'>, ('auto',)), None, None)
    """
    parts = [part for part in (get_args(kind) if get_origin(kind) is not Literal else ()) or (kind,)]
    words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
    numbers = [part for part in parts if get_origin(part) is not Literal and part is not type(None)]
    if len(numbers) != 1 or numbers[0] not in _READERS or get_origin(kind) is tuple:
        return None
    return numbers[0], tuple(words)


@cache
def described(options: type) -> type:
    """Return the dataclass of options itself, annotated so that its help has whole paragraphs and no word
    None.

    By itself, tyro keeps the line breaks of attribute docstrings, and shows None as a value and as a default.
    If the default is None, False or empty, the help text alone says what happens without the option.
    """
    from docstring_parser import parse_from_object
    from tyro.conf import arg

    kinds = [kind for kind in reversed(options.__mro__) if is_dataclass(kind)]
    told = {doc.arg_name: doc.description or "" for kind in kinds for doc in parse_from_object(kind).params}
    hints = get_type_hints(options, include_extras=True)
    for option in fields(options):
        hint = hints[option.name]
        if is_dataclass(hint):
            described(hint)
            continue
        text = " ".join(told[option.name].split())
        is_said = option.default is not False and option.default not in (None, (), MISSING)
        shown = arg(help=text, metavar=_metavar(hint), help_behavior_hint=None if is_said else "")
        options.__annotations__[option.name] = Annotated[hint, shown]
    return options


def _metavar(kind: Any) -> str | None:
    """Return the placeholder for the value of an option that may be None; None for other options and numbers.

    >>> _metavar(Path | None), _metavar(Literal["alex", "vgg"] | None), _metavar(tuple[str, float] | None)
    ('PATH', '{alex,vgg}', 'NAME FLOAT')
    >>> _metavar(Path), _metavar(int | None)
    (None, None)
    """
    parts = [part for part in get_args(kind) if part is not NoneType]
    if len(parts) != 1 or NoneType not in get_args(kind):
        return None
    (part,) = parts
    if get_origin(part) is Literal:
        return "{" + ",".join(get_args(part)) + "}"
    if get_origin(part) is tuple:
        return " ".join(_METAVARS[some] for some in get_args(part))
    return "PATH" if part is Path else None
