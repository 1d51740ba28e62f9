"""Preview of a training: a view beside its photograph, written to a file now and then to be looked at."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
from PIL import Image

from player.errors import OutputError
from player.files.files import write_bytes
from player.files.images import png_bytes, to_8_bit
from vfr_bake.data.scene import Scene
from vfr_bake.data.witnesses import whole_views
from vfr_bake.rendering.render import render_image
from vfr_bake.training.scores.metrics import comparison, over_background
from vfr_bake.training.trainer import Trainer

SECONDS = 60.0
"""Seconds of training between two previews."""
SIDE = 320
"""Pixels of a preview's longest side, at most: such a picture takes a second or two."""

MARK = "preview of vfr-train"
"""Text near the beginning of every preview: a PNG file without it is another picture, and is not replaced."""


def preview_path(model: Path) -> Path:
    """Return the path of the preview for the training of `model`.

    >>> preview_path(Path("a/fox.pt")).name
    'fox.preview.png'
    """
    return model.with_name(model.stem + ".preview.png")


class Preview:
    """A view of a scene that training does not learn from, and the file that shows it. The view is one of the
    test split, else one of the whole views that are kept apart (`vfr_bake.data.witnesses`); a scene with
    fewer views shows one that it learns from."""

    def __init__(self, scene: Scene, path: Path) -> None:
        views = scene.test if scene.test.cameras else scene.train
        candidates = range(len(views.cameras)) if views is scene.test else whole_views(len(views.cameras))
        number = int(candidates[len(candidates) // 2]) if len(candidates) else len(views.cameras) // 2
        self._camera = camera = views.cameras[number].at_most(SIDE)
        rgba = views.images[number]
        mean = rgba[..., :3].mean(axis=(0, 1)) / 255
        self._background = mean if scene.unbounded else np.array(scene.background)
        whole = Image.fromarray(to_8_bit(over_background(rgba, self._background)))
        self._photograph = np.asarray(whole.resize((camera.width, camera.height), Image.Resampling.BOX)) / 255
        self._path = path
        # Not earlier: while all of the box is still fog, a picture takes many times as long.
        self._due = SECONDS / 4

    def update(self, trainer: Trainer) -> None:
        """Write the preview if SECONDS of training have passed since the last one."""
        if trainer.seconds >= self._due:
            self.write(trainer)
            self._due = trainer.seconds + SECONDS

    def write(self, trainer: Trainer) -> None:
        """Write photograph | rendered | error map, replacing the last preview.

        A preview that cannot be written, for example because a program on Windows has the last one open, is
        left out, and training goes on.
        """
        rgb = render_image(trainer.field, trainer.sampler, self._camera, self._background)
        with suppress(OutputError):
            write_bytes(self._path, png_bytes(comparison(self._photograph, rgb), MARK))
