"""The messages that a browser may send to the viewer: where its camera is, and what one of its own controls
was set to.

Every message is decoded with a strict schema, and encoded anew before it goes on to viser. viser itself would
set any attribute of a control that a client names, and calculate with any number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

MAX_BYTES = 4096
"""Most bytes of a message; a browser's has some 250."""

FAR = 1e9
"""Largest coordinate of a camera in viser's frame; float32 rays from further away are too coarse."""

Check = Callable[[Any], Any]
"""A function from what a client sent to the value that a control takes, or to None if it takes none."""

_Side = Annotated[int, Meta(ge=0, le=1 << 20)]
_Place = tuple[float, float, float]


class _Camera(msgspec.Struct, tag="ViewerCameraMessage", forbid_unknown_fields=True):
    wxyz: tuple[float, float, float, float]
    position: _Place
    fov: float
    near: float
    far: float
    image_height: _Side
    image_width: _Side
    look_at: _Place
    up_direction: _Place


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: (
        bool | int | float | Annotated[str, Meta(max_length=1024)] | Annotated[list[Any], Meta(max_length=4)]
    )


class _Update(msgspec.Struct, tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: Annotated[str, Meta(max_length=64)]
    updates: _Value


CAMERA_FIELDS = _Camera.__struct_fields__
UPDATE_FIELDS = _Update.__struct_fields__

_decoder = msgspec.msgpack.Decoder(_Camera | _Update)


def cleaned(raw: bytes | str, controls: Mapping[str, Check]) -> tuple[bool, bytes] | None:
    """Check a message. Returns whether it is about the camera, and the message encoded for viser; None if it
    is to be ignored.

    `controls`: the checks of values for the client's controls, by the names that these have in messages.

    >>> import msgspec
    >>> sent = msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 900}})
    >>> is_camera, data = cleaned(sent, {"a": within(lambda: (0, 16), whole=True)})
    >>> is_camera, msgspec.msgpack.decode(data)["updates"]
    (False, {'value': 16})
    >>> cleaned(sent, {}) is None and cleaned(b"garbage", {}) is None
    True
    """
    if not isinstance(raw, bytes):
        return None
    try:
        message = _decoder.decode(raw)
    except (msgspec.MsgspecError, RecursionError, ValueError):
        return None
    if isinstance(message, _Camera):
        return (True, msgspec.msgpack.encode(message)) if _is_camera(message) else None
    check = controls.get(message.uuid)
    value = None if check is None else check(message.updates.value)
    if value is None:
        return None
    return False, msgspec.msgpack.encode(_Update(message.uuid, _Value(value)))


def _is_camera(camera: _Camera) -> bool:
    """Return whether a picture can be rendered for a camera, and viser can calculate with it."""
    places = (*camera.position, *camera.look_at)
    numbers = (*camera.wxyz, *camera.up_direction, camera.near, camera.far)
    return (
        all(abs(value) <= FAR for value in places)  # False for NaN
        and all(map(math.isfinite, numbers))
        and 1e-3 <= camera.fov <= 3.1
        and abs(math.hypot(*camera.wxyz) - 1) <= 1e-2
        and 1e-6 <= math.hypot(*camera.up_direction) <= 1e6
        and math.dist(camera.position, camera.look_at) > 0
    )


# --- what a control takes ---


def within(bounds: Callable[[], tuple[float, float]], whole: bool) -> Check:
    """Make the check of a slider: it takes the nearest number between its bounds, which are asked for each
    time."""

    def check(value: Any) -> float | None:
        if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
            return None
        low, high = bounds()
        value = min(max(value, low), high)
        return round(value) if whole else float(value)

    return check


def one_of(options: Sequence[str]) -> Check:
    """Make the check of a dropdown: it takes one of its options."""
    return lambda value: value if isinstance(value, str) and value in options else None


def colour(value: Any) -> list[int] | None:
    """Check a colour: a list of three numbers, each taken as the nearest byte."""
    take = within(lambda: (0, 255), whole=True)
    levels = [take(part) for part in value] if isinstance(value, list) else []
    return None if len(levels) != 3 or None in levels else levels


def pressed(value: Any) -> bool | None:
    """Check a button: it takes True alone."""
    return True if value is True else None
