"""The record that is kept beside cameras estimated from pictures: which pixels the cameras belong to, and
which pictures were left out or not placed."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from player.errors import FormatError
from player.files.json_files import parse_json, read_json

NAME = "pictures.json"


@dataclass(frozen=True)
class EstimateRecord:
    """The facts about its pictures that an estimate records."""

    upright: bool
    """Whether the cameras belong to pictures turned upright as EXIF says, and not to the pixels as stored."""
    repeated: dict[str, str] = field(default_factory=dict)
    """Names of pictures that were left out, each with the name of the picture that shows the same."""
    unplaced: dict[str, str] = field(default_factory=dict)
    """The reason why a picture was not placed, by the picture's name."""
    apart: tuple[int, ...] = ()
    """Number of pictures in each further group, whose pictures were placed relative to each other but not to
    the rest."""
    n_bytes: dict[str, int] = field(default_factory=dict)
    """Size of each picture's file in bytes, by the picture's name; empty in a record of an older version."""

    def why_without_camera(self) -> dict[str, str]:
        """Return why pictures have no camera, by their names.

        >>> EstimateRecord(True, {"b.jpg": "a.jpg"}, {"c.jpg": "blank"}).why_without_camera()
        {'c.jpg': 'blank', 'b.jpg': 'shows what a.jpg does'}
        """
        shown = {name: f"shows what {kept} does" for name, kept in self.repeated.items()}
        return {**self.unplaced, **shown}


def write_record(model: Path, record: EstimateRecord) -> None:
    """Write the record into the folder of a COLMAP model."""
    document = asdict(record)
    (model / NAME).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_record(model: Path) -> EstimateRecord:
    """Read the record in the folder of a COLMAP model. If there is none, the model was made by another
    program, and its cameras belong to the pixels as stored. Raises FormatError.

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
    n_bytes = document.get("n_bytes", {})
    if not isinstance(n_bytes, dict) or not all(isinstance(number, int) for number in n_bytes.values()):
        raise FormatError(f"{path}: n_bytes: expected sizes of files: remove {model} to begin anew")
    return EstimateRecord(document["upright"], apart=tuple(apart), n_bytes=n_bytes, **told)
