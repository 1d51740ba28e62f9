"""Command-line options of `vfr-train`, `vfr-bake`, `vfr-eval` and `vfr-bench`; `tyro` makes the parsers from
these classes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from vfr_bake.config import BakeConfig, BenchConfig, TrainConfig


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a Volume Feature Rendering field on photographs.

    The model file holds everything that vfr-bake needs. Ctrl-C ends training early and keeps the model, and a
    checkpoint beside it from which --resume goes on.

    examples:
      vfr-train photos/ model.pt                  estimate the cameras, and train for at most 12 minutes
      vfr-train photos/ --check                   are the pictures good enough? Ten seconds, no training
      vfr-train photos/ model.pt --effort draft   two minutes, for a first look
      vfr-train photos/ model.pt --preview        and write a picture every minute
      vfr-train photos/ model.pt --resume         go on where an interrupted run stopped
    """

    data: Positional[str]
    """A folder of photographs, a ZIP of them or a video, whose cameras are estimated first; or a folder with
    cameras: transforms_train.json (NeRF-synthetic), transforms.json or a COLMAP model (sparse/0); or `demo`,
    the built-in scene."""
    model: Positional[Path | None] = None
    """The model file to write, for example model.pt; with --check it is not written, and may be left out."""
    check: bool = False
    """Train nothing: look at the pictures for some ten seconds, and say what is likely to come out and what
    to photograph in addition. Writes a page, with --json the same as data."""
    html: Path | None = None
    """With --check: the page to write; DATA_check.html in the current folder if not given."""
    config: TrainConfig = field(default_factory=TrainConfig)
    force: bool = False
    """Replace an earlier model, or with --check an earlier page. Another file is never replaced."""
    no_cache: bool = False
    """Do not keep the pictures, reduced and decoded, for the next run with them (docs/train.md), and remove
    them if they are kept."""
    resume: bool = False
    """Go on from the checkpoint that an interrupted run left beside the model file, and replace the model of
    that run; without a checkpoint, begin."""
    preview: bool = False
    """Every minute, write a view that is not learned from beside its photograph, and where they differ, to
    MODEL.preview.png (model.preview.png for model.pt): a second or two each time."""
    json: Path | None = None
    """Also write what was measured as JSON to this file; - for stdout."""


@dataclass(frozen=True, kw_only=True)
class Bake:
    """Bake a trained model into an asset: sparse 8-bit grid, ONNX head and mesh, played by vfr-play on any
    CPU.

    The data set is not needed; the model file holds the training cameras.

    examples:
      vfr-bake model.pt out/                   small and quick to play
      vfr-bake model.pt out/ --preset phone    the fewest bytes, for pages on phones
      vfr-bake model.pt out/ --max-mb 5        the preset, with at most five megabytes
      vfr-bake --convert old/ new/             rewrite an asset of an earlier version of the format
    """

    model: Positional[Path]
    """A model file written by vfr-train; with --convert, the folder of an asset."""
    asset: Positional[Path]
    """The folder to write."""
    convert: bool = False
    """Bake nothing: rewrite an asset in the current version of the format, which takes fewer bytes and shows
    a first picture early. Its pictures, head, cameras and reports stay what they are, and its mesh is made
    again; of the settings --max-memory alone has a meaning."""
    config: BakeConfig = field(default_factory=BakeConfig)
    force: bool = False
    """Replace the folder if it exists, and holds an asset and nothing else."""
    json: Path | None = None
    """Also write what was measured as JSON to this file; - for stdout."""


@dataclass(frozen=True, kw_only=True)
class Eval:
    """Render the test views with the full model and compare them with the photographs, over the
    model's background.

    examples:
      vfr-eval model.pt photos/
      vfr-eval model.pt photos/ --pictures views/    and look at every view beside its photograph
    """

    model: Positional[Path]
    """A model file written by vfr-train."""
    data: Positional[str]
    """The data set, as for vfr-train."""
    json: Path | None = None
    """Write the means (psnr in dB, ssim, lpips; of 8-bit pictures; psnr_float and ssim_float unrounded) and
    per_view as JSON to this file; - for stdout. A PSNR without bound is null, and so is LPIPS where a view
    has masked pixels."""
    lpips: Literal["alex", "vgg"] | None = None
    """Also measure LPIPS with this network, whose weights have to be on this machine."""
    max_memory: float | None = None
    """Gigabytes of memory that reading the model may take; half of the machine's if not given."""
    pictures: Path | None = None
    """Also write photograph | rendered | error map of every view to this folder, replacing files of equal
    name; it has to lie outside the data set. The error map is black where nothing differs, white where the
    difference is a quarter of the range or more."""


@dataclass(frozen=True, kw_only=True)
class Bench(BenchConfig):
    """Measure what baked assets of one scene give and take: quality, time, size, memory, for every number of
    lookups a ray.

    Prints the Pareto front, with the commands that bake and play its settings, and what to choose.

    examples:
      vfr-bench out/ --data photos/
      vfr-bench out/ fast/ --data photos/ --model model.pt --html trade.html
    """

    assets: Positional[tuple[Path, ...]]
    """Folders of assets of one scene."""
    lpips: Literal["alex", "vgg"] | None = None
    """Also measure LPIPS with this network, whose weights have to be on this machine."""
    html: Path | None = None
    """Also write a page with plots, and where the loss sits, to this file."""
    json: Path | None = None
    """Also write everything as JSON to this file; - for stdout, instead of the table."""
    force: bool = False
    """Replace an earlier page and earlier results. Other files are never replaced."""
