"""What is kept beside the cameras that were estimated from pictures: which pixels they belong to, and which
pictures were left out or found no place."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from player.errors import FormatError
from player.files.json_files import parse_json, read_json

NAME = "pictures.json"


@dataclass(frozen=True)
class EstimateRecord:
    """What an estimate says of its pictures."""

    upright: bool
    """Whether the cameras belong to pictures turned upright as EXIF says, and not to the pixels as stored."""
    repeated: dict[str, str] = field(default_factory=dict)
    """Pictures that were left out because another shows the same, and which."""
    unplaced: dict[str, str] = field(default_factory=dict)
    """Why a picture found no place, by its name."""
    apart: tuple[int, ...] = ()
    """Numbers of pictures of the groups that have places of their own, which fit nothing of the rest."""


def write_record(model: Path, record: EstimateRecord) -> None:
    """Write the record into the folder of a COLMAP model."""
    document = asdict(record)
    (model / NAME).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_record(model: Path) -> EstimateRecord:
    """The record in the folder of a COLMAP model; pixels as stored where there is none, because the model was
    made by another program. Raises FormatError.

    >>> read_record(Path("surely/not/there")).upright
    False
    """
    path = model / NAME
    if not path.exists():
        return EstimateRecord(upright=False)
    document = parse_json(read_json(path, "what an estimate says of its pictures"), str(path))
    if not isinstance(document, dict) or not isinstance(document.get("upright"), bool):
        raise FormatError(f"{path}: upright: expected true or false: remove {model} to begin anew")
    told = {}
    for key in ("repeated", "unplaced"):
        told[key] = document.get(key, {})
        if not isinstance(told[key], dict) or not all(isinstance(text, str) for text in told[key].values()):
            raise FormatError(f"{path}: {key}: expected names of pictures: remove {model} to begin anew")
    apart = document.get("apart", [])
    if not isinstance(apart, list) or not all(isinstance(number, int) for number in apart):
        raise FormatError(f"{path}: apart: expected numbers of pictures: remove {model} to begin anew")
    return EstimateRecord(document["upright"], apart=tuple(apart), **told)
