"""What is masked in the pictures is neither drawn nor kept as a witness nor scored."""

from __future__ import annotations

from dataclasses import fields
from typing import Protocol

import numpy as np
import torch

from player.errors import TrainingError
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.rays import RayBatch

MOST_DRAWS = 100
"""So many batches without an opaque pixel mean that there is none."""


class Draws(Protocol):
    """What draws random pixels."""

    def draw(self, n_rays: int) -> RayBatch: ...


def draw_unmasked(sampler: Draws, n_rays: int) -> RayBatch:
    """`n_rays` random pixels of those that are opaque; what is masked is drawn again until none is left.

    Some of the pixels have to be opaque (`vfr_bake.data.files.masks.check_masked`). Raises TrainingError:
    none of MOST_DRAWS times as many were.
    """
    batch, n_draws = _opaque(sampler.draw(n_rays)), 1
    while (missing := n_rays - len(batch.rgba)) > 0:
        if n_draws == MOST_DRAWS and not len(batch.rgba):
            raise TrainingError("training pictures: expected pixels that are not masked, found none")
        n_draws += 1
        more = _opaque(sampler.draw(n_rays))
        batch = RayBatch(
            *(
                torch.cat([getattr(batch, field.name), getattr(more, field.name)[:missing]])
                for field in fields(RayBatch)
            )
        )
    return batch


def _opaque(batch: RayBatch) -> RayBatch:
    seen = batch.rgba[:, 3] == 1
    return RayBatch(*(rows[seen] for rows in vars(batch).values()))


def unmasked_witnesses(witnesses: Witnesses) -> Witnesses:
    """The witnesses that are opaque: what a bake shows where a picture is masked is no loss.

    >>> rgba = np.array([[9, 9, 9, 255], [9, 9, 9, 0]], np.uint8)
    >>> two = Witnesses(np.array([2], np.int32), np.array([3, 5], np.int32), rgba, np.zeros(0, np.int32))
    >>> unmasked_witnesses(two).pixels.tolist()
    [3]
    """
    seen = witnesses.rgba[:, 3] == 255
    counts = np.bincount(witnesses.views()[seen], minlength=len(witnesses.counts)).astype(np.int32)
    return Witnesses(counts, witnesses.pixels[seen], witnesses.rgba[seen], witnesses.whole)
