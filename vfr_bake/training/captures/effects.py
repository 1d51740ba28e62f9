"""Effects of real captures that a field cannot show, detected and corrected while a field is trained.

A capture's exposure may change from picture to picture (`exposure`), and things in it may move (`moving`).
The corrections for both are off at first; after each number of steps in CHECKS, the effects are looked for.
An effect that is not found by the last check stays off, and takes no more time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from vfr_bake.training.captures import moving
from vfr_bake.training.captures.exposure import (
    LEAST_GAIN_DB,
    N_SUMS,
    Correction,
    fit,
    gain_on_other_half,
    products,
)
from vfr_bake.training.processes import Processes

CHECKS = (256, 512, 1024, 2048, 4096, 8192)
"""Numbers of steps after which changing exposure and moving things are looked for."""
STEPS_PER_UPDATE = 16
"""Steps between two updates of the gains, the offsets and the cells that are left out."""
MEMORY_STEPS, MEMORY_PIXELS = 512, 4096
"""Length of the moving averages: about this many steps, or as many steps as draw this many pixels of each
picture, whichever is longer."""


@dataclass(frozen=True)
class Seen:
    """Colours and errors that a step found on its rays."""

    pictures: Tensor
    """[n_rays] int64: number of each ray's picture, among those that are drawn from."""
    places: Tensor
    """[n_rays, 2] in (0, 1): each pixel's place, as shares of the picture's width and height."""
    colours: Tensor
    """[n_rays, 3]: the field's colours times opacity."""
    opacity: Tensor
    """[n_rays]."""
    wanted: Tensor
    """[n_rays, 3]: the photographs' colours without the part of the background."""
    solid: Tensor
    """[n_rays] bool: true where both the photograph and the field are nearly opaque. Errors at the edges of
    an object are those of its outline, which no gain explains."""
    errors: Tensor
    """[n_rays, 3]: the rendered colours minus the target colours."""


class CaptureEffects:
    """Corrections of the pictures: their gains and offsets, and the cells of them that are not learned
    from."""

    def __init__(self, n_pictures: int, processes: Processes, device: torch.device) -> None:
        self._processes = processes
        side = moving.cells_per_side(n_pictures)
        self._n_pictures, self._side = n_pictures, side
        number = {"dtype": torch.float64, "device": device}
        self._halves = torch.zeros(2 * n_pictures, 3, N_SUMS, **number)
        self._cells = torch.zeros(n_pictures * side * side, moving.N_SUMS, **number)
        self._new = [torch.zeros_like(sums) for sums in (self._halves, self._cells)]
        """Sums over what this process has seen since the last update."""
        self.exposure_gain: float | None = None
        """Reduction of the error in dB by gains and offsets, at the last check; None before the first
        check."""
        self.exposure_on = False
        self.moving_share: float | None = None
        """Share of the cells that stood out at the last check; None before the first check."""
        self.moving_on = False
        self._contradicting = torch.zeros(n_pictures, side, side, dtype=torch.bool, device=device)
        self._n_steps = 0
        self._n_rays = 0
        self._set_correction(
            Correction(torch.ones(n_pictures, 3, **number), torch.zeros(n_pictures, 3, **number))
        )
        self._left_out = self._contradicting

    @property
    def looks(self) -> bool:
        """True if steps still have to be observed."""
        return self.exposure_on or self.moving_on or self._n_steps < CHECKS[-1]

    @property
    def share_left_out(self) -> float:
        """Share of the pictures' area that is not learned from, because something moves there."""
        return float(self._left_out.double().mean())

    def shown(self, colours: Tensor, opacity: Tensor, pictures: Tensor) -> Tensor:
        """Return the colours [n, 3] with which the `pictures` [n] show the field's `colours` [n, 3]; both are
        times `opacity` [n]."""
        if not self.exposure_on:
            return colours
        return colours * self._gains[pictures] + self._offsets[pictures] * opacity[:, None]

    def learned(self, pictures: Tensor, places: Tensor) -> Tensor | None:
        """Return [n] bool: true for the rays that the field learns from; None if it learns from all."""
        return ~self._left_out.view(-1)[self._cell(pictures, places)] if self.moving_on else None

    def observe(self, seen: Seen, n_rays: int) -> None:
        """Add what this process has `seen` of a step, which has `n_rays` rays over all processes."""
        halves, cells = self._new
        errors = seen.errors.double()
        squares = errors.square().sum(dim=1, keepdim=True)
        cell = self._cell(seen.pictures, seen.places)
        cells.index_add_(0, cell, torch.cat([torch.ones_like(squares), errors, squares], dim=1))
        terms = products(seen.colours, seen.opacity, seen.wanted)
        learned = self.learned(seen.pictures, seen.places)
        fits = seen.solid if learned is None else seen.solid & learned
        half = 2 * seen.pictures + (seen.places[:, 0] >= 0.5)
        halves.index_add_(0, half[fits], terms[fits])
        self._n_steps += 1
        self._n_rays += n_rays
        if self._n_steps % STEPS_PER_UPDATE == 0:
            self._update()

    def _cell(self, pictures: Tensor, places: Tensor) -> Tensor:
        x, y = (self._side * places).long().clamp(max=self._side - 1).unbind(dim=1)
        return (pictures * self._side + y) * self._side + x

    def _update(self) -> None:
        memory = max(MEMORY_STEPS, MEMORY_PIXELS * self._n_pictures * self._n_steps / max(self._n_rays, 1))
        forget = 1 - min(1.0, STEPS_PER_UPDATE / memory)
        self._processes.add_up(self._new)
        for sums, new in zip((self._halves, self._cells), self._new, strict=True):
            sums.mul_(forget).add_(new)
            new.zero_()
        if self._n_steps in CHECKS:
            self._check()
        if self.exposure_on:
            by_picture = self._halves.view(self._n_pictures, 2, 3, N_SUMS).sum(dim=1)
            self._set_correction(fit(by_picture).neutral())
        if self.moving_on:
            self._contradicting = moving.contradicting(self._mean_errors(), self._contradicting)
            self._left_out = moving.widened(self._contradicting)
            if self.share_left_out > moving.MOST_LEFT_OUT:
                self.moving_on = False
                self._contradicting = self._left_out = torch.zeros_like(self._contradicting)

    def _check(self) -> None:
        if not self.exposure_on:
            self.exposure_gain = gain_on_other_half(self._halves.view(self._n_pictures, 2, 3, N_SUMS))
            self.exposure_on = self.exposure_gain > LEAST_GAIN_DB
            if self.exposure_on:
                self._cells.zero_()  # their errors include those of the exposure
        if not self.moving_on and float(self._cells[:, 0].mean()) >= moving.MEAN_PIXELS:
            errors = self._mean_errors()
            self.moving_share = float(moving.contradicting(errors).double().mean())
            self.moving_on = moving.something_moves(errors)

    def _mean_errors(self) -> Tensor:
        return moving.mean_errors(self._cells).view(self._n_pictures, self._side, self._side)

    def _set_correction(self, correction: Correction) -> None:
        self.correction = correction
        self._gains, self._offsets = correction.gains.float(), correction.offsets.float()

    def described(self) -> list[str]:
        """Return what was found and done, one line for each effect."""
        return [self._exposure_described(), self._moving_described()]

    def _exposure_described(self) -> str:
        if self.exposure_gain is None:
            return f"exposure: taken to be the same in all pictures; looked at from {CHECKS[0]} steps on"
        if not self.exposure_on:
            return (
                "exposure: the same in all pictures, as far as it shows (gains for each picture would change "
                f"the error by {-self.exposure_gain:.2f} dB)"
            )
        gains = self.correction.gains.mean(dim=1)
        return (
            f"exposure: changes from picture to picture, by factors of {float(gains.min()):.2f} to "
            f"{float(gains.max()):.2f} of the mean; gains and offsets are learned for each picture"
        )

    def _moving_described(self) -> str:
        if self.moving_share is None:
            return "moving things: not looked for in so few steps, all pixels are learned from"
        if not self.moving_on:
            return "moving things: none found, all pixels are learned from"
        return (
            f"moving things: {100 * self.share_left_out:.1f} % of the pictures contradict the others and are "
            "left out"
        )

    def figures(self) -> dict[str, Any]:
        """Return what was found and done as data, in plain values."""
        gains = self.correction.gains.mean(dim=1)
        return {
            "exposure": self.exposure_on,
            "exposure_gain_db": self.exposure_gain,
            "gains": [float(gains.min()), float(gains.max())],
            "moving": self.moving_on,
            "share_left_out": self.share_left_out,
        }

    def state(self) -> dict[str, Any]:
        """Return all that later steps depend on, as tensors and plain values."""
        return {
            "halves": self._halves, "cells": self._cells, "new": list(self._new),
            "n_steps": self._n_steps, "n_rays": self._n_rays,
            "exposure_on": self.exposure_on, "exposure_gain": self.exposure_gain,
            "gains": self.correction.gains, "offsets": self.correction.offsets,
            "moving_on": self.moving_on, "moving_share": self.moving_share,
            "contradicting": self._contradicting, "left_out": self._left_out,
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned."""
        self._halves.copy_(state["halves"])
        self._cells.copy_(state["cells"])
        for new, kept in zip(self._new, state["new"], strict=True):
            new.copy_(kept)
            if not self._processes.first:
                new.zero_()  # the first process adds it to the sum over all processes
        self._n_steps, self._n_rays = state["n_steps"], state["n_rays"]
        self.exposure_on, self.exposure_gain = state["exposure_on"], state["exposure_gain"]
        self.moving_on, self.moving_share = state["moving_on"], state["moving_share"]
        device = self._halves.device
        self._set_correction(Correction(state["gains"].to(device), state["offsets"].to(device)))
        self._contradicting = state["contradicting"].to(device)
        self._left_out = state["left_out"].to(device)
