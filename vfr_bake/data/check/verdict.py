"""Judge the figures of a check: what is likely to come out, and what to photograph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from player.cameras.camera import Camera, focus_point, world_up
from vfr_bake.data.poses import MIN_PICTURES, MIN_SHARE

SOFT_SHARPNESS = 15.0
"""If the median sharpness is less, all pictures are out of focus, blurred, or enlarged."""
GOOD_SHARED = 40
"""Neighbours that share at least this many features, at the size of the check, overlap well."""
UNEVEN = 0.7
"""Largest difference in brightness, in powers of two, between pictures that show the same; a larger one
becomes fog. It is compared with the difference that 95 in 100 pairs of pictures do not exceed."""
FEW, GOOD_NUMBER = 20, 40
"""Numbers of pictures: fewer than FEW leave holes; about GOOD_NUMBER show a subject from all sides."""
TURNED, ALL_TURNED = 0.4, 0.8
"""Shares of the steps in which the camera turned on the spot. Above TURNED, depth is weak; above ALL_TURNED,
cameras are hardly found."""
GAP_DEGREES = 90.0
"""Degrees. A wider gap in the walk around the subject is a side that nobody has seen."""
NAMED = 3
"""Number of pictures that are named, at most, of those that cannot be read."""
GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"


def judged(
    figures: dict[str, Any],
    cameras: Sequence[Camera],
    unreadable: Sequence[str],
    wrong_masks: Sequence[str],
    places: str,
) -> tuple[str, list[str], list[str]]:
    """Return the verdict, what is likely to come out, and what to photograph. `unreadable`: the names of
    pictures that would make training stop. `wrong_masks`: what is wrong with masks that would.
    `places`: a clause on groups of pictures that have nothing in common; empty for one group."""
    n, seen = figures["n_pictures"], max(figures["n_looked_at"], 1)
    likely, advice, bad, doubts = [], [], False, False
    turned = figures["share_turned_on_the_spot"] or 0.0
    all_turned = turned > ALL_TURNED and not cameras
    if cameras:
        likely.append(f"the cameras of {figures['n_found']} pictures are known.")
        bad = figures["n_found"] < 2
    else:
        share, n_repeated = figures["share_in_one_group"], figures["n_repeated"]
        n_different = round(n * (1 - n_repeated / seen))
        alike = n_different < MIN_PICTURES
        apart = share < MIN_SHARE and places
        bad = alike or share < MIN_SHARE / 2 or bool(apart)
        doubts |= share < 0.9
        placed = (
            "are from one place, which tells no depth" if all_turned or (alike and n_repeated)
            else "are likely to find their cameras"
        )  # fmt: skip
        about = round(share * n_different)
        likely.append(f"about {about} of {n_different} pictures hang together and {placed}.")
        if n_repeated:
            likely.append(f"{n - n_different} more show what another one does.")
        if alike and n_repeated:
            advice.append("move around the subject, and photograph it from different places.")
        elif apart:
            advice.append(f"{apart}.")
        elif share < 0.9:
            advice.append(
                "photograph with steps of some 10 degrees, so that each picture shows most of what the one "
                "before it does, and add pictures between those that share nothing."
            )
        elif figures["shared_features"] < GOOD_SHARED:
            advice.append(
                "take smaller steps, or keep more of textured surroundings in the picture: neighbours "
                "share few features."
            )
    if unreadable:
        bad = True
        others = f" and {len(unreadable) - NAMED} others" if len(unreadable) > NAMED else ""
        advice.append(
            f"copy {', '.join(unreadable[:NAMED])}{others} again, or leave them out: what cannot be read to "
            "its end ends the training."
        )
    if wrong_masks:
        bad = True
        others = f"; masks that are wrong, in all: {len(wrong_masks)}" if len(wrong_masks) > 1 else ""
        advice.append(f"{wrong_masks[0]}{others}.")
    if turned > TURNED:
        doubts = True
        bad |= all_turned
        advice.append(
            f"move: from picture to picture the camera turned on the spot ({turned:.0%} of the steps). Walk "
            "around the subject."
        )
    if n < FEW:
        doubts = True
        advice.append(f"take more pictures: {n} leave holes, {GOOD_NUMBER} to 100 show a subject well.")
    if figures["sharpness"] < SOFT_SHARPNESS:
        doubts = True
        advice.append(
            "all pictures are soft: focus on the subject, use more light, hold still while the shutter is "
            "open; the model will be no sharper than they are."
        )
    if figures["n_blurred"]:
        doubts |= figures["n_blurred"] > 0.2 * seen
        advice.append(f"take the {figures['n_blurred']} blurred pictures again, or leave them out.")
    if figures["n_plain"] and not cameras:
        bad |= figures["n_plain"] > 0.5 * seen
        advice.append(
            "put something with a pattern under or behind the subject: there is nothing to recognise in "
            f"{figures['n_plain']} pictures."
        )
    if figures["exposure_spread"] > UNEVEN:
        advice.append(
            "lock the exposure: pictures show the same things up to "
            f"{2 ** figures['exposure_spread']:.1f} times as bright as each other, which becomes fog."
        )
    gap = widest_gap(cameras)
    if gap is not None and gap > GAP_DEGREES:
        advice.append(
            f"photograph the other side as well: the cameras leave {gap:.0f} degrees around the subject open."
        )
    likely.append(
        "Training is not worth its minutes yet." if bad
        else "A model comes out, with weak places." if doubts
        else "A good model is likely."
    )  # fmt: skip
    return BAD if bad else DOUBTFUL if doubts else GOOD, likely, advice


def widest_gap(cameras: Sequence[Camera]) -> float | None:
    """Return the widest gap between the cameras, in degrees, seen from above around the point that they look
    at; None for too few cameras, or if they look outwards."""
    if len(cameras) < 3:
        return None
    focus, up = focus_point(cameras), world_up(cameras)
    arms = np.stack([camera.c2w[:3, 3] for camera in cameras]) - focus
    looks = -np.stack([camera.c2w[:3, 2] for camera in cameras])
    if np.median((arms * looks).sum(axis=1) / np.maximum(np.linalg.norm(arms, axis=1), 1e-9)) > -0.5:
        return None
    right, back = level_axes(up)
    angles = np.sort(np.degrees(np.arctan2(arms @ back, arms @ right)))
    return float(np.diff([*angles, angles[0] + 360]).max())


def level_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions [3] of unit length at right angles to `up` [3] and to each other."""
    right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right /= np.linalg.norm(right)
    return right, np.cross(right, up)
