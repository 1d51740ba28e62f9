"""Readers of option values for argparse; their errors say what is expected, with an example."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path

DEMO = Path(__file__).parent / "demo"
"""The baked asset of the built-in scene, which comes with the player."""
COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def wrong(expected: str, example: str, text: str) -> argparse.ArgumentTypeError:
    """Make the error that a reader raises for a wrong `text`.

    >>> str(wrong("a whole number", "3", "x"))
    "expected a whole number, such as 3, got 'x'"
    """
    return argparse.ArgumentTypeError(f"expected {expected}, such as {example}, got {text!r}")


def asset_folder(text: str) -> Path:
    """Return the folder of an asset; the word `demo` stands for that of the built-in scene.

    >>> asset_folder("out/").name, asset_folder("demo") == DEMO, asset_folder("./demo").is_absolute()
    ('out', True, False)
    """
    return DEMO if text == DEMO.name else Path(text)


def joined_negatives(argv: Sequence[str], *options: str) -> list[str]:
    """Join `--crop -1,0,...` to one word, for these `options`: otherwise argparse takes a value that begins
    with a minus for an option.

    >>> joined_negatives(["out", "--crop", "-.5,0,0,1,1,1", "a.ply", "--views", "-3:"], "--crop", "--views")
    ['out', '--crop=-.5,0,0,1,1,1', 'a.ply', '--views=-3:']
    """
    words = list(argv)
    for index in range(len(words) - 2, -1, -1):
        value = words[index + 1]
        if words[index] in options and value[:1] == "-" and value[1:2] in set(".0123456789"):
            words[index : index + 2] = [f"{words[index]}={value}"]
    return words


def whole(least: int | None = None, most: int | None = None, example: int = 10) -> Callable[[str], int]:
    """Make a reader of whole numbers from `least` to `most`.

    >>> whole(1)("12"), whole()("-3")
    (12, -3)
    """
    expected = "a whole number"
    if least is not None:
        expected += f" from {least} on" if most is None else f", {least} to {most}"

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise wrong(expected, str(example), text) from None
        if (least is not None and value < least) or (most is not None and value > most):
            raise wrong(expected, str(example), text)
        return value

    return read


def number(
    what: str, example: str, above: float = -math.inf, most: float = math.inf
) -> Callable[[str], float]:
    """Make a reader of finite numbers over `above`, up to `most`.

    >>> number("seconds", "300", above=0)("0.5")
    0.5
    """
    expected = f"{what}, a number" if what else "a number"
    expected += f" over {above:g}" if above > -math.inf else ""
    expected += f" up to {most:g}" if most < math.inf else ""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (above < value <= most and math.isfinite(value)):
            raise wrong(expected, example, text)
        return value

    return read


positive = whole(1)
gigabytes = number("gigabytes", "4", above=0, most=1e9)


def size(text: str) -> tuple[int, int]:
    """Read a width and a height, up to a million pixels each.

    >>> size("800x600")
    (800, 600)
    """
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0
    if not (1 <= width <= 1_000_000 and 1 <= height <= 1_000_000):
        raise wrong("WIDTHxHEIGHT, 1 to 1000000 each", "800x600", text)
    return width, height


def background(text: str) -> str | tuple[float, float, float]:
    """Read a colour, returned as 0..1, or "transparent".

    >>> background("255,0,51"), background("white")
    ((1.0, 0.0, 0.2), (1.0, 1.0, 1.0))
    """
    if text == "transparent":
        return text
    if text in COLOURS:
        return COLOURS[text]
    try:
        red, green, blue = (int(part) for part in text.split(","))
    except ValueError:
        red = green = blue = -1
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise wrong("white, black, transparent or R,G,B in 0..255", "255,128,0", text)
    return red / 255, green / 255, blue / 255


def part(text: str) -> slice:
    """Read a slice as Python writes it; a single number is a slice of one view.

    >>> part("0:40"), part("::2"), part("3"), part("-1")
    (slice(0, 40, None), slice(None, None, 2), slice(3, 4, None), slice(-1, None, None))
    """
    try:
        parts = [int(number) if number.strip() else None for number in text.split(":")]
    except ValueError:
        parts = []
    if len(parts) == 1 and parts[0] is not None:
        return slice(parts[0], parts[0] + 1 or None)
    if not 2 <= len(parts) <= 3 or (len(parts) == 3 and parts[2] == 0):
        raise wrong("START:STOP or START:STOP:STEP", "0:40", text)
    return slice(*parts)
