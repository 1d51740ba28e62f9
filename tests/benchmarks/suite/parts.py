"""All parts of the benchmarks, in the order in which they are run and recorded."""

from __future__ import annotations

from functools import partial
from typing import Any

from tests.benchmarks.suite import played
from tests.benchmarks.suite.little import write_data_sets
from tests.benchmarks.suite.scenes import SCENES, Scene, bake, score, train
from tests.benchmarks.suite.work import Part, Work

LEGO, FOX, CAN, DEMO = (SCENES[name] for name in ("lego", "fox", "can", "demo"))
LONGEST_PART, LONGEST_CORE = 120.0, 150.0
"""Minutes that a part, and all parts of the core together, may take on two cores."""
PRESETS = {
    "lego": {"fidelity": 7.0, "balanced": 7.0, "fast": 6.0, "phone": 5.0},
    "fox": {"balanced": 9.5, "phone": 7.5},
    "can": {"balanced": 9.0},
    "demo": {"balanced": 7.0},
}
"""Presets with which each scene is baked, and the minutes of each, like all parts' without AVX-512."""
LIMITS_MB = ("1", "2", "3")
"""Limits on the size of lego's balanced asset, in MB, for the curve of loss by bytes."""
DIALS = {
    "head32": ("--head-width", "32"),
    "head128": ("--head-width", "128"),
    "channels8": ("--n-channels", "8"),
    "cells400": ("--resolution", "400"),
}
"""Settings that are changed one at a time in lego's balanced asset."""
MINUTES = (1.0, 2.0, 5.0)
"""Minutes of shorter trainings of lego."""
SEEDS = (0, 1, 2)
REFINED_AT = {"every": "0", "k5": "5"}
"""Numbers of lookups for which the assets of the parts `lookups` are baked and refined; 0: every sample."""


COMPILING = ("train_lego", "train_fox", "eval_lego", "eval_fox", "bake_lego_balanced", "bake_lego_fidelity",
             "bake_fox_balanced", "bake_fox_phone", "play_fox_phone")  # fmt: skip
"""Parts that together use all compiled code."""


def compiled(work: Work) -> dict[str, Any]:
    """Run a few parts on tiny data, so that code is compiled and kept before anything is timed."""
    if not work.quick:
        write_data_sets(work.folder / "data")
        for name in COMPILING:
            little = Work(name, work.folder, work.folder / "data", quick=True)
            little.folder.mkdir()
            PARTS[name].measure(little)
    return {}


def bakes(scene: Scene) -> tuple[str, ...]:
    """Return the names of the parts that bake the presets of a scene."""
    return tuple(f"bake_{scene.name}_{preset}" for preset in PRESETS[scene.name])


def plays(scene: Scene) -> tuple[str, ...]:
    """Return the names of the parts that play the assets of `bakes`."""
    return tuple(f"play_{scene.name}_{preset}" for preset in PRESETS[scene.name])


PAGES = {name.replace("bake_", "page_"): name for name in (*bakes(LEGO)[1:], "bake_fox_phone")}
"""Parts that measure a page, and the parts that bake their assets."""


def _training(scene: Scene, minutes: float) -> Part:
    measure = partial(train, scene=scene)
    return Part(f"train_{scene.name}", measure, minutes, ("compiled",), scene.data)


def _score(scene: Scene, minutes: float) -> Part:
    trained = f"train_{scene.name}"
    measure = partial(score, scene=scene, model_of=trained)
    return Part(f"eval_{scene.name}", measure, minutes, (trained,), scene.data)


def _shorter(minutes: float) -> list[Part]:
    """Return the parts that train lego for fewer minutes and score it."""
    trained = f"train_lego_{minutes:g}"
    measures = partial(train, scene=LEGO, minutes=minutes), partial(score, scene=LEGO, model_of=trained)
    return [
        Part(trained, measures[0], minutes + 0.5, ("compiled",), LEGO.data, core=False),
        Part(f"eval_lego_{minutes:g}", measures[1], 4.0, (trained,), LEGO.data, core=False),
    ]


def _bake(name: str, model_of: str, minutes: float, *options: str, core: bool = True) -> Part:
    return Part(name, lambda work: bake(work, model_of, *options), minutes, (model_of,), core=core)


def _play(scene: Scene, name: str, of: str) -> Part:
    measure = partial(played.qualities, scene=scene, asset_of=of)
    core = not name.endswith("_phone")  # the trade has frames of `phone` too, but not of the slow march
    return Part(name, measure, 4.0 if scene.unbounded else 1.5, (of,), scene.data, core)


def _trade(name: str, scene: Scene, of: tuple[str, ...], minutes: float, core: bool = True) -> Part:
    samples = ("1", "2", "3", "5", "8", "0")
    needs = (f"train_{scene.name}", *of)
    return Part(name, lambda work: played.trade(work, scene, of, samples), minutes, needs, scene.data, core)


def _lookups(scene: Scene, minutes: float) -> list[Part]:
    """Return parts that train with three seeds, bake for every sample and for few lookups, and play all."""
    parts, columns = [], {}
    for seed in SEEDS:
        trained = f"train_{scene.name}_seed{seed}"
        training = partial(train, scene=scene, minutes=4, seed=seed)
        parts.append(Part(trained, training, 4.5, ("compiled",), scene.data, core=False))
        for name, k in REFINED_AT.items():
            baked = f"bake_{scene.name}_seed{seed}_{name}"
            parts.append(_bake(baked, trained, 6.0, "--k", k, core=False))
            columns[f"{name}, seed {seed}"] = baked
    needs = tuple(columns.values())
    measure = partial(played.lookups, scene=scene, bakes=columns)
    return [*parts, Part(f"lookups_{scene.name}", measure, minutes, needs, scene.data, core=False)]


def _core() -> list[Part]:
    presets = [
        _bake(f"bake_{name}_{preset}", f"train_{name}", minutes, "--preset", preset)
        for name, some in PRESETS.items()
        for preset, minutes in some.items()
    ]
    balanced = "bake_lego_balanced"
    return [
        Part("compiled", compiled, 4.0),
        *(_training(*pair) for pair in ((LEGO, 9.5), (FOX, 12.5), (CAN, 13.5), (DEMO, 2.5))),
        *(_score(*pair) for pair in ((LEGO, 2.5), (FOX, 1.5), (CAN, 4.0), (DEMO, 0.5))),
        *presets,
        _trade("trade_lego", LEGO, bakes(LEGO), 11.0),
        _trade("trade_fox", FOX, bakes(FOX), 6.0),
        _trade("trade_demo", DEMO, bakes(DEMO), 1.5),
        *(
            _play(scene, name, of)
            for scene in (LEGO, FOX)
            for name, of in zip(plays(scene), bakes(scene), strict=True)
        ),
        Part("export_lego", partial(played.exports, asset_of=balanced), 6.5, (balanced,)),
        *(Part(name, partial(played.page, asset_of=of), 1.0, (of,)) for name, of in PAGES.items()),
    ]


def _more() -> list[Part]:
    """Return the parts that take long for what they show, and are run on request only."""
    dials = [
        _bake(f"dial_lego_{name}", "train_lego", 4.0, *words, core=False) for name, words in DIALS.items()
    ]
    dialled = ("bake_lego_balanced", *(part.name for part in dials))
    return [
        *(_bake(f"bytes_lego_{mb}", "train_lego", 5.5, "--max-mb", mb, core=False) for mb in LIMITS_MB),
        *(part for minutes in MINUTES for part in _shorter(minutes)),
        *dials,
        _trade("trade_can", CAN, bakes(CAN), 7.5, core=False),
        _trade("trade_dials", LEGO, dialled, 8.0, core=False),
        *_lookups(LEGO, 25.0),
        *_lookups(FOX, 25.0),
        Part(
            "cameras_lego", partial(played.cameras, data="lego_800_train"), 4.0, (), "lego_800_train", False
        ),
        Part("cameras_fox", partial(played.cameras, data="fox"), 3.0, (), "fox", False),
        Part("cameras_ring", played.ring, 20.0, core=False),
        Part("compositing_lego", played.compositing, 9.0, ("compiled",), "lego_400", core=False),
        Part("steps_lego", played.steps, 6.0, ("compiled",), "lego_400", core=False),
        Part(
            "viewers_lego",
            partial(played.viewers, scene=LEGO, asset_of="bake_lego_balanced"),
            2.0,
            ("bake_lego_balanced",),
            LEGO.data,
            core=False,
        ),
        Part("specks_lego", played.specks, 4.0, ("train_lego", "bake_lego_balanced"), core=False),
    ]


PARTS = {part.name: part for part in (*_core(), *_more())}
