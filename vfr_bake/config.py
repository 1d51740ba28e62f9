"""All settings, in a frozen dataclass for each command. The attribute docstrings are shown as help texts, and
state the units."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from player.app.option_types import size
from player.errors import ConfigError
from player.files.json_files import brief
from player.files.memory import SHARE, allowed_bytes
from vfr_bake.presets import PRESETS, UNBOUNDED, BakeChoice, Preset

SceneKind = Literal["auto", "object", "unbounded"]
Compositing = Literal["features", "colour"]
Activation = Literal["gelu", "relu"]
ViewEncoding = Literal["sh-features", "sh"]
Device = Literal["auto", "cpu", "cuda"]
Effort = Literal["draft", "good", "best"]
CHOICES = {
    "compositing": get_args(Compositing),
    "activation": get_args(Activation),
    "view_encoding": get_args(ViewEncoding),
}
UNBOUNDED_FIELD: dict[str, Any] = {
    "unbounded": True,
    "max_resolution": 2048,
    "density_width": 0,
    "sh_degree": 7,
    "n_sh_features": 8,
}
"""Architecture settings of the paper's real-world scenes that differ from those of objects (table 2), except
the number of levels: the paper's 32 would double the time of a step on a CPU, most of which is spent on the
grid's memory."""


FIELD_BY_DEVICE: dict[str, dict[str, Any]] = {"cpu": {"head_width": 128}, "cuda": {"log2_table_size": 19}}
"""Architecture settings that follow from the device. On a GPU, tables are as large as the paper's. On a CPU,
the paper's head would take about half of a step's time, and a head of half its width allows nearly twice as
many steps (docs/notes/2026-11-25-width-of-the-head.md)."""


BEST_OBJECT_FIELD = {"log2_table_size": 22, "sh_degree": 7}
"""Architecture settings of an object that is trained with the effort `best` on a CPU. Within ten minutes its
model would gain a third of a decibel, too, but bakes of it lose more
(docs/notes/2026-11-30-tables-and-directions.md)."""


def check(settings: object, name: str, fits: bool, expected: str) -> None:
    """Raise ConfigError, which says what was `expected`, unless the setting `name` `fits`."""
    if not fits:
        raise ConfigError(f"{name}: expected {expected}, got {brief(getattr(settings, name))}")


@dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """Architecture of a field (section 4 of the paper); stored in the model file. `FieldOptions` says what
    its settings mean."""

    unbounded: bool = False
    """Whether the grid covers all of space, contracted, or the box [-1, 1]^3 alone."""
    n_levels: int = 16
    base_resolution: int = 16
    max_resolution: int = 512
    log2_table_size: int = 20
    density_width: int = 64
    compositing: Compositing = "features"
    head_width: int = 256
    n_directional_layers: int = 4
    activation: Activation = "gelu"
    view_encoding: ViewEncoding = "sh-features"
    sh_degree: int = 4
    n_sh_features: int = 4

    def __post_init__(self) -> None:
        check(self, "n_levels", 1 <= self.n_levels <= 32, "1 to 32")
        fits = 2 <= self.base_resolution <= self.max_resolution
        check(self, "base_resolution", fits, "2 to max_resolution")
        check(self, "max_resolution", self.max_resolution <= 8192, "at most 8192")
        check(self, "log2_table_size", 10 <= self.log2_table_size <= 24, "10 to 24")
        check(self, "density_width", 0 <= self.density_width <= 1024, "0 to 1024")
        check(self, "head_width", 4 <= self.head_width <= 1024, "4 to 1024")
        check(self, "n_directional_layers", 1 <= self.n_directional_layers <= 16, "1 to 16")
        check(self, "sh_degree", 1 <= self.sh_degree <= 8, "1 to 8")
        check(self, "n_sh_features", 1 <= self.n_sh_features <= 32, "1 to 32")
        for name, choices in CHOICES.items():
            check(self, name, getattr(self, name) in choices, f"one of {', '.join(choices)}")

    @property
    def n_channels(self) -> int:
        """Number of feature channels of a point: two per level."""
        return 2 * self.n_levels


def field_config_from(values: dict[str, Any], where: str) -> FieldConfig:
    """Return a FieldConfig from plain values as a model file keeps them. Raises ConfigError for unknown or
    missing names and for values of a wrong type."""
    defaults = asdict(FieldConfig())
    if set(values) != set(defaults):
        raise ConfigError(f"{where}: expected the settings {sorted(defaults)}, got {brief([*values])}")
    for name, value in values.items():
        kind = type(defaults[name])
        if type(value) is not kind:
            raise ConfigError(
                f"{where}: {name}: expected a value of type {kind.__name__}, got {brief(value)}"
            )
    return FieldConfig(**values)


@dataclass(frozen=True, kw_only=True)
class FieldOptions:
    """Architecture as `vfr-train` takes it: what is not given follows from the kind of scene."""

    n_levels: int | None = None
    """Levels of the hash grid, two feature channels each; 16 (paper: 32 for unbounded scenes,
    which double the time of a CPU step)."""
    base_resolution: int | None = None
    """Cells per axis of the coarsest level; 16."""
    max_resolution: int | None = None
    """Cells per axis of the finest level; objects 512 (over the box), unbounded scenes 2048 (contracted)."""
    log2_table_size: int | None = None
    """A level with more vertices than two to this power shares entries by hashing. CPU: 20, because places
    that share an entry disturb each other in views that are not learned from; 22 for an object with --effort
    best. GPU: 19, as in the paper."""
    density_width: int | None = None
    """Hidden width of the density network, 0 for a linear map; objects 64, unbounded scenes 0 (paper)."""
    compositing: Compositing = "features"
    """Sum features along the ray and evaluate the head once a pixel (volume feature rendering), or evaluate
    it at every sample and sum colours (standard volume rendering, the paper's baseline)."""
    head_width: int | None = None
    """Width of every layer of the head, and of its bottleneck; CPU 128, GPU 256 as in the paper."""
    n_directional_layers: int = 4
    """Layers of the directional MLP behind the two spatial ones."""
    activation: Activation = "gelu"
    """Between the head's layers."""
    view_encoding: ViewEncoding = "sh-features"
    """Spherical harmonics times features that the head predicts (the paper's equation 4), or alone."""
    sh_degree: int | None = None
    """Bands of spherical harmonics: degree 4 means l = 0..3, 16 functions; objects 4, or 7 with --effort best
    on a CPU; unbounded scenes 7."""
    n_sh_features: int | None = None
    """Features that multiply each basis function; objects 4, unbounded scenes 8, as in the paper."""

    def resolved(self, unbounded: bool, device: str = "cpu", effort: Effort = "good") -> FieldConfig:
        """Return the architecture with every open setting filled in. Raises ConfigError for values out of
        range."""
        chosen = (UNBOUNDED_FIELD if unbounded else {}) | FIELD_BY_DEVICE[device]
        if effort == "best" and device == "cpu" and not unbounded:
            chosen |= BEST_OBJECT_FIELD
        given = {name: value for name, value in asdict(self).items() if value is not None}
        return FieldConfig(**(chosen | given))


@dataclass(frozen=True, kw_only=True)
class DeviceSettings:
    """Settings of a training that follow from the device and the kind of scene if they are not given.
    `TrainConfig` says what each of them means."""

    steps: int = 1_000_000
    batch_samples: int = 4096
    batch_rays: int = 512
    max_rays: int = 16_384
    grid_rate: float = 1e-2
    network_rate: float = 4e-3
    pilot_steps: int = 300
    distortion: float = 0.05

    def __post_init__(self) -> None:
        check(self, "steps", self.steps >= 1, "at least 1")
        check(self, "batch_samples", 1024 <= self.batch_samples <= 2**22, "1,024 to 4,194,304")
        check(self, "batch_rays", 32 <= self.batch_rays <= 2**17, "32 to 131,072")
        check(self, "max_rays", 1 <= self.max_rays <= 2**20, "1 to 1,048,576")
        check(self, "grid_rate", 0 < self.grid_rate < 1, "between 0 and 1")
        check(self, "network_rate", 0 < self.network_rate < 1, "between 0 and 1")
        check(self, "pilot_steps", self.pilot_steps >= 0, "at least 0")
        check(self, "distortion", 0 <= self.distortion < 1e3, "0 to 1000")


GPU_SETTINGS = {
    "batch_samples": 2**18,
    "batch_rays": 2**13,
    "max_rays": 2**16,
    "grid_rate": 1e-2,
    "network_rate": 1e-2,
}
"""The paper's settings for a GPU. Only `max_rays` is not the paper's: most rays of an object meet nothing."""
GPU_STEPS = {False: 20_000, True: 40_000}
"""The paper's number of steps, by whether the scene is unbounded."""


SCENE_DISTORTION = 0.002
"""Weight of an unbounded scene's distortion loss."""
EFFORT_MINUTES = {"draft": (2.0, 2.0), "good": (10.0, 12.0), "best": (60.0, 60.0)}
"""Most minutes of training on a CPU, for an object and for an unbounded scene, by the effort."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of the training. Those that are not given follow from the device: on a CPU they are made for
    two cores, on a GPU they are the paper's."""

    kind: SceneKind = "auto"
    """Object: a box, sampled through an occupancy grid. Unbounded: all of space, contracted. Auto: an object
    if at least half of the pictures have transparent pixels, or if the background is plain."""
    device: Device = "auto"
    """Where to train: a GPU that CUDA runs on, or the CPU. Auto: the GPU if there is one."""
    max_side: int | None = None
    """Pictures whose longest side has more pixels are reduced to so many; 1600, or fewer where the disk has
    no room for the pictures."""
    downscale: int | None = None
    """Reduce all pictures by this factor along each side instead, whatever their size is; 1 for pictures as
    they are."""
    scale: tuple[str, str, float] | None = None
    """Two pictures and how far apart their cameras were, for example `IMG_1.jpg IMG_9.jpg 2.5`: the world is
    then in the unit of that distance, metres for glTF and USD, in every export. Pictures alone do not tell
    how large anything is."""
    effort: Effort = "good"
    """How long a training may take on a CPU: draft 2 minutes, good 10 (unbounded scenes 12), best 60, for
    which an object gets larger tables and a finer view encoding. It ends earlier when the error on pixels not
    learned from is flat. A GPU takes its steps, a draft 2 minutes."""
    steps: int | None = None
    """Optimiser steps: so many are taken if the minutes allow it. CPU: as many as they allow; GPU: 20,000
    (unbounded scenes 40,000) with far larger batches, as in the paper."""
    minutes: float | None = None
    """Minutes at most, instead of those of the effort; the learning-rate schedule runs on whichever of steps
    and minutes is further."""
    batch_samples: int | None = None
    """Objects: samples along rays in a batch; GPU 262,144, CPU 4,096, because the time of a CPU step
    grows with it, and many small steps teach more than few large ones: the same 25 million samples gave lego
    26.3 dB in steps of 16,384, 27.1 in steps of 8,192 and 27.8 in steps of 4,096. On a CPU it grows to
    twice as many from step 6,000 on."""
    batch_rays: int | None = None
    """Unbounded scenes: rays in a batch; GPU 8,192, CPU 512, for the same reason. On a CPU it grows to four
    times as many from step 2,000 on."""
    max_rays: int | None = None
    """Objects: rays in a batch at most, however few samples they need; GPU 65,536, CPU 16,384."""
    grid_rate: float | None = None
    """Adam learning rate of the hash grids; 0.01."""
    network_rate: float | None = None
    """Adam learning rate of the density network and the head; GPU 0.01, as in the paper, CPU 0.004."""
    pilot_steps: int | None = None
    """Number of the first steps, in which a small pilot network renders colours sample by sample (section 3.3
    of the paper); 300, but no more than a quarter of the training."""
    step_cells: float = 3.0
    """Objects: length of a march step in training, in cells of the finest level; steps of pictures are half
    as long. Longer steps leave room for more rays in a batch: lego after 1,500 steps had 22.4 dB with 1.4
    cells, 23.0 with 2 and 23.4 with 3."""
    occupancy_resolution: int = 128
    """Objects: cells per axis of the occupancy grid."""
    distortion: float | None = None
    """Weight of the distortion loss (mip-NeRF 360), which draws the weights of a ray together: objects 0.05,
    within a hundredth of the box; unbounded scenes 0.002, where five times as much puts fog before surfaces
    of one colour."""
    near_gradients: float = 2.0
    """Unbounded scenes: what is nearer to a camera than this learns more slowly, by its squared distance, so
    that no fog settles before the cameras; model units, in which nine in ten cameras are nearer than 1; 0:
    all learn alike."""
    seed: int = 0
    """Seed of every random number."""
    eval_views: int | None = None
    """Test views rendered at the end, spread evenly; 0 for none. Objects 10, unbounded scenes 3, a view of
    which takes half a minute; fewer if they would take more than a fifth of the training's time. `vfr-eval`
    renders them all."""
    checkpoint_minutes: float = 2.0
    """Minutes between two checkpoints, kept beside the model file until training is complete."""
    field: FieldOptions = field(default_factory=FieldOptions)

    def __post_init__(self) -> None:
        check(self, "kind", self.kind in get_args(SceneKind), f"one of {get_args(SceneKind)}")
        check(self, "max_side", self.max_side is None or 16 <= self.max_side <= 65536, "16 to 65,536")
        check(self, "downscale", self.downscale is None or 1 <= self.downscale <= 64, "1 to 64")
        known = self.scale is None or 0 < self.scale[2] < 1e9
        check(self, "scale", known, "two pictures, and a distance of more than 0")
        check(self, "effort", self.effort in get_args(Effort), f"one of {get_args(Effort)}")
        check(self, "device", self.device in get_args(Device), f"one of {get_args(Device)}")
        fits = self.minutes is None or 0 < self.minutes <= 1e6
        check(self, "minutes", fits, "more than 0, and at most a million")
        check(self, "step_cells", 0.1 <= self.step_cells <= 16, "0.1 to 16")
        check(self, "occupancy_resolution", 8 <= self.occupancy_resolution <= 512, "8 to 512")
        check(self, "near_gradients", 0 <= self.near_gradients < 1e3, "0 to 1000")
        check(self, "seed", 0 <= self.seed < 2**63, "at least 0, and less than 2**63")
        check(self, "eval_views", self.eval_views is None or self.eval_views >= 0, "at least 0")
        check(self, "checkpoint_minutes", self.checkpoint_minutes > 0, "more than 0")
        # So that values out of range are refused before pictures are read. The kind of scene, where it is not
        # given, may turn out to be the one with the finer grid, which allows more.
        self.for_device("cpu", False)
        self.field.resolved(self.kind != "object")

    def minutes_for(self, device: str, unbounded: bool) -> float:
        """Return the largest number of minutes of training on `device` ("cpu" or "cuda").

        >>> TrainConfig().minutes_for("cpu", True), TrainConfig(effort="draft").minutes_for("cuda", True)
        (12.0, 2.0)
        """
        if self.minutes is not None:
            return self.minutes
        if device == "cuda" and self.effort != "draft":
            return math.inf
        return EFFORT_MINUTES[self.effort][unbounded]

    def for_device(self, device: str, unbounded: bool) -> DeviceSettings:
        """Return the given settings, and those that `device` ("cpu" or "cuda") and kind of scene suggest.

        >>> TrainConfig(steps=7).for_device("cuda", False).steps, TrainConfig().for_device("cuda", True).steps
        (7, 40000)
        """
        defaults: dict[str, Any] = {"distortion": SCENE_DISTORTION} if unbounded else {}
        if device == "cuda":
            defaults |= {"steps": GPU_STEPS[unbounded]} | GPU_SETTINGS
        given = {name: getattr(self, name) for name in DeviceSettings.__dataclass_fields__}
        return DeviceSettings(
            **(defaults | {name: value for name, value in given.items() if value is not None})
        )


USUAL_MEMORY, LEAST_MEMORY = 4.0, 0.85
"""Gigabytes of memory that a bake takes at most if no number is given, and that the smallest bake needs."""


@dataclass(frozen=True, kw_only=True)
class BakeConfig:
    """Settings of the bake. Those that are not given follow from the preset."""

    preset: Preset | None = None
    """Fidelity: for final pictures, nearly the model's own. Balanced: small and quick to play. Fast: fewer
    bytes and a smaller head. Phone: the fewest bytes, for pages on phones. Not given: balanced, or fidelity
    if balanced loses more than --max-loss-db."""
    resolution: int | None = None
    """Cells per axis of the baked densities, at most half again the field's finest level."""
    feature_resolution: int | None = None
    """Cells per axis of the baked features, at most the field's finest level and no more than the densities
    have. Not given: the preset's share of those."""
    n_channels: int | None = None
    """Exact number of feature channels to store; the projection to them is folded into the head. Not given:
    as few as the preset's loss allows."""
    k: int | Literal["auto"] = "auto"
    """Feature lookups per ray, exactly; 0 looks up every sample. Auto: as few as the preset's loss allows.
    The player can be asked for another number."""
    weight_floor: float | None = None
    """A cell is stored if some view gives one of its samples at least this weight. Not given: the highest of
    a few that loses next to nothing on training pixels, or none; 0.01 for an unbounded scene."""
    no_cull: bool = False
    """Store every cell in which the model may hold matter, also where no view sees it."""
    code_levels: int | None = None
    """Largest feature code, 7 to 127: fewer levels take fewer bytes."""
    head_width: int | None = None
    """Width of a smaller head, which learns from the model's own; 0 keeps that one."""
    head_bits: int | None = None
    """Bits of the head's wide layers, 8 or 32 (float32): 8 play about twice as fast, and stay only where they
    lose no more than the preset allows, or where --target-ms limits the time of a frame."""
    refine_steps: int | None = None
    """Steps in which head and stored values are adapted to each other, to show what photographs and the full
    model show; two thirds as many follow with the lookups and bits that are played. 0: none, with the model's
    own head. If not given, the preset's, or as many as there is time for."""
    mesh_resolution: int | None = None
    """The mesh gets the faces that a grid of so many voxels along the box would give it; 0: as many as its
    bytes allow, a tenth of the asset's."""
    max_loss_db: float | None = None
    """Take the fewest bytes that lose at most this against photographs; fail, and write nothing, if the
    written files lose more all the same. Without --preset, a bake whose refined values lose more begins
    again with fidelity."""
    max_mb: float | None = None
    """Store the values less precisely than the preset does, on coarser grids if need be, until the asset fits
    into this many megabytes, the report not counted; fail, and write nothing, if it takes more all the
    same."""
    target_ms: float | None = None
    """Take no wider a head, no more lookups and no finer grids than a frame of 800x800 in so many
    milliseconds allows, measured by the player on this machine; fail, and write nothing, if it takes longer
    all the same."""
    max_memory: float | None = None
    """Gigabytes of memory that the bake may take: with less, the bake learns from fewer rays and its grids
    are coarser. Not given: half of the machine's, at most 4 and at least 0.85, which any bake needs."""
    check_views: int = 4
    """Views between the training cameras on which each step of the bake is compared with the model's own
    pictures; 1 to 1,000; the more views, the fewer pixels of each are compared."""

    def __post_init__(self) -> None:
        check(self, "preset", self.preset is None or self.preset in PRESETS, f"one of {tuple(PRESETS)}")
        check(self, "resolution", self.resolution is None or 8 <= self.resolution <= 2048, "8 to 2048")
        most = self.resolution or 2048
        fits = self.feature_resolution is None or 8 <= self.feature_resolution <= most
        check(self, "feature_resolution", fits, "8 to 2048, at most the resolution")
        for name in ("max_loss_db", "max_mb", "target_ms", "max_memory"):
            limit = getattr(self, name)
            check(self, name, limit is None or limit > 0, "more than 0")
        check(self, "check_views", 1 <= self.check_views <= 1000, "1 to 1,000")
        check(self, "k", self.k == "auto" or 0 <= self.k <= 64, "auto or 0 to 64")
        fits = self.weight_floor is None or 0 < self.weight_floor < 1
        check(self, "weight_floor", fits, "between 0 and 1")
        fits = self.weight_floor is None or not self.no_cull
        check(self, "weight_floor", fits, "none with --no-cull, which stores every cell")
        choice = self.choice()
        check(choice, "n_channels", 1 <= choice.n_channels <= 64, "1 to 64")
        check(choice, "code_levels", 7 <= choice.code_levels <= 127, "7 to 127")
        check(choice, "head_width", choice.head_width == 0 or 8 <= choice.head_width <= 256, "0 or 8 to 256")
        learns = self.refine_steps != 0 or not self.head_width
        check(self, "head_width", learns, "0 with --refine-steps 0, because a smaller head has to learn")
        check(choice, "refine_steps", 0 <= choice.refine_steps <= 1_000_000, "0 to 1,000,000")
        check(choice, "head_bits", choice.head_bits in (8, 32), "8 or 32")
        fits = choice.mesh_resolution == 0 or 8 <= choice.mesh_resolution <= 1024
        check(choice, "mesh_resolution", fits, "0 or 8 to 1024")

    @property
    def memory(self) -> float:
        """Gigabytes of memory that the bake may take on this machine."""
        half = allowed_bytes() / 1e9
        usual = min(USUAL_MEMORY, max(half, min(LEAST_MEMORY, half / SHARE)))  # no more than there is
        return usual if self.max_memory is None else self.max_memory

    def choice(self, unbounded: bool = False) -> BakeChoice:
        """Return the preset's choice for an object or an unbounded scene; settings that are given replace it.

        >>> BakeConfig(preset="fast", n_channels=5).choice().n_channels, BakeConfig().choice().head_width
        (5, 64)
        >>> BakeConfig(k=3).choice().n_fetches, BakeConfig(k="auto").choice().n_fetches
        (3, 12)
        >>> BakeConfig().choice(unbounded=True).refine_steps
        2600
        """
        preset = _choice(self.preset or "balanced", unbounded)
        given = {name: getattr(self, name, None) for name in BakeChoice.__dataclass_fields__}
        given["n_fetches"] = None if self.k == "auto" else self.k
        choice = replace(preset, **{name: value for name, value in given.items() if value is not None})
        return choice if choice.refine_steps else replace(choice, head_width=0)


def _choice(preset: Preset, unbounded: bool) -> BakeChoice:
    """Return what `preset` chooses for an object or an unbounded scene."""
    return replace(PRESETS[preset], **UNBOUNDED[preset]) if unbounded else PRESETS[preset]


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """Settings of `vfr-bench`: what it measures."""

    assets: tuple[Path, ...]
    """Folders of assets of one scene."""
    data: str
    """The data set, as for vfr-train: its test views are compared."""
    model: Path | None = None
    """Also measure this full model, and count losses from it."""
    views: int = 8
    """Test views, spread evenly."""
    sizes: tuple[str, ...] = ()
    """Sizes of the timed frames, for example 400x400 800x800; the photographs' own, half and twice of it if
    none is given. The front is drawn for the photographs' own, which is always measured."""
    samples: tuple[int, ...] = (1, 2, 3, 4, 5, 8, 12, 16, 32, 0)
    """Numbers of lookups a ray, 0 for every sample; the assets' own is always among them."""
    frames: int = 20
    """Timed frames of each setting and size."""
    minutes: float = 10
    """Minutes of the whole measurement, roughly: on a slow machine fewer frames are timed, at least two of
    each setting and size, and fewer test views are compared, at least one."""
    threads: int | None = None
    """Threads of the player; one for each core if not given."""
    max_memory: float | None = None
    """Gigabytes of memory that each asset, and the model, may take when it is opened; half of the machine's
    if not given."""

    def check(self) -> None:
        """Check the settings; raises ConfigError for what cannot be measured."""
        if not self.assets:
            raise ConfigError("assets: expected at least one folder, got none")
        if len(set(self.assets)) < len(self.assets):
            raise ConfigError(f"assets: expected each once, got {[*map(str, self.assets)]}")
        if not self.samples:
            raise ConfigError("samples: expected at least one number, got none")
        check(self, "views", self.views >= 1, "at least 1")
        if not all(0 <= k <= 1024 for k in self.samples):
            raise ConfigError(f"samples: expected 0 to 1024, got {[*self.samples]}")
        check(self, "frames", self.frames >= 2, "at least 2")
        check(self, "minutes", self.minutes > 0, "more than 0")
        check(self, "threads", self.threads is None or self.threads >= 1, "at least 1")
        self.frame_sizes()

    def frame_sizes(self) -> list[tuple[int, int]]:
        """Return `sizes` as pairs of width and height in pixels. Raises ConfigError."""
        try:
            return [size(text) for text in self.sizes]
        except ArgumentTypeError as error:
            raise ConfigError(f"sizes: {error}") from None
