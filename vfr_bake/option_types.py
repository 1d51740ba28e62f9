"""Numbers on the command lines that `tyro` makes: their errors say what is expected."""

from __future__ import annotations

from argparse import ArgumentTypeError
from typing import Any, Literal, get_args, get_origin

from player.app.option_types import number, whole

_READERS = {int: ("INT", whole()), float: ("FLOAT", number("", "2.5"))}


def registry() -> Any:
    """tyro's rules, with one for an option that is a number: of type `int`, `float | None`, `int |
    Literal["auto"]` or `tuple[int, ...]`."""
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
    """The number and the words that an annotation allows.

    >>> _parts(int), _parts(float | None), _parts(int | Literal["auto"]), _parts(str | None), _parts(bool)
    ((<class 'int'>, ()), (<class 'float'>, ()), (<class 'int'>, ('auto',)), None, None)
    """
    parts = [part for part in (get_args(kind) if get_origin(kind) is not Literal else ()) or (kind,)]
    words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
    numbers = [part for part in parts if get_origin(part) is not Literal and part is not type(None)]
    if len(numbers) != 1 or numbers[0] not in _READERS or get_origin(kind) is tuple:
        return None
    return numbers[0], tuple(words)
