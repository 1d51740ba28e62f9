"""What the commands may write to, checked before any work: what is there is replaced only if it is an earlier
result of the same kind."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from zipfile import ZIP_STORED, BadZipFile, ZipFile

from player.app.commands import check_result
from player.asset.target import asset_files
from player.errors import OutputError
from player.files.content import has_content
from player.files.files import check_target

RESULTS = (
    {"model", "steps", "seconds"},  # vfr-train
    {"page", "verdict", "advice"},  # vfr-train --check
    {"asset", "megabytes", "seconds"},  # vfr-bake
    {"psnr", "per_view", "n_views"},  # vfr-eval
    {"conditions", "recommendation"},  # vfr-bench
)
"""Keys by which a JSON file is known as the result of a command."""


def check_model_target(path: Path, force: bool) -> None:
    """Raise OutputError if a model cannot be written to `path`. With `force`, a model or an empty file is
    replaced, and nothing else."""
    check_target(path, force, is_file=True)
    if has_content(path) and not _is_model(path):
        raise OutputError(
            f"{path}: expected a new file or an earlier model, got another file: name a new one"
        )


def check_preview_target(path: Path, force: bool) -> None:
    """Raise OutputError if the preview of a training cannot be written to `path`. With `force`, an earlier
    preview or an empty file is replaced, and nothing else."""
    from vfr_bake.training.preview import MARK

    check_target(path, force, is_file=True)
    if has_content(path) and MARK.encode() not in _beginning(path):
        raise OutputError(
            f"{path}: expected a new file or an earlier preview, got another file: name another model"
        )


def check_page_target(path: Path, force: bool, mark: str | None = None) -> None:
    """Raise OutputError if a web page cannot be written to `path`. With `force`, or if it has the `mark` near
    its beginning, a page is replaced; with `force`, an empty file, too; and nothing else."""
    begin = _beginning(path)
    check_target(path, force or (mark is not None and mark.encode() in begin), is_file=True)
    if has_content(path) and not begin.lower().startswith(b"<!doctype"):
        raise OutputError(f"{path}: expected a new file or an earlier page, got another file: name a new one")


def check_json_target(
    path: Path | None, inputs: Collection[Path], output: Path | None = None, force: bool = True
) -> None:
    """Raise OutputError if the result of a command cannot be written to `path` (--json).

    Args:
        path: a file; None and "-" are no file.
        inputs: files and folders that the command reads, as for `check_result`.
        output: a file or folder that the command writes; the result may be neither it nor in it.
        force: whether an earlier result is replaced; nothing else ever is.
    """
    check_result(path, inputs, RESULTS, force=force)
    if path is None or str(path) == "-":
        return
    if output is not None and path.resolve().is_relative_to(output.resolve()):
        raise OutputError(f"{path}: --json: expected a file outside {output}, which is written, too")
    if asset_files(path.parent) is not None:
        raise OutputError(f"{path}: --json: expected a file outside the asset {path.parent}")


def check_pictures_target(folder: Path, data: str) -> None:
    """Raise OutputError if pictures cannot be written to `folder`, or if they could replace those of `data`,
    which may have the same names."""
    check_target(folder / "0.png", force=True, is_file=True)
    if data != "demo" and folder.resolve().is_relative_to(Path(data).resolve()):
        raise OutputError(f"{folder}: --pictures: expected a folder outside {data}, which is read")


def _beginning(path: Path) -> bytes:
    """Return the first bytes of a file; none of what is no file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(200)


def _is_model(path: Path) -> bool:
    """Return whether a file is a model of whatever version. Only its description is read."""
    from vfr_bake.training.model_file import FORMAT

    try:
        with ZipFile(path) as archive:
            return any(
                entry.filename.endswith("data.pkl")
                and entry.compress_type == ZIP_STORED
                and FORMAT.encode() in archive.read(entry)
                for entry in archive.infolist()
            )
    except (BadZipFile, OSError):
        return False
