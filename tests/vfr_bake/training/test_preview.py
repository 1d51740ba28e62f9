"""The preview: a picture that is written while a field learns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from vfr_bake.commands.targets import check_preview_target
from vfr_bake.config import TrainConfig
from vfr_bake.data.demo import demo_scene
from vfr_bake.data.scene import Scene
from vfr_bake.data.witnesses import whole_views
from vfr_bake.training.preview import SECONDS, SIDE, Preview
from vfr_bake.training.trainer import Trainer


def trained(n_steps: int) -> tuple[Trainer, Scene]:
    scene = demo_scene(size=48, n_train=8, n_test=3)
    trainer = Trainer(scene, TrainConfig(steps=n_steps, device="cpu", pilot_steps=5))
    for _ in trainer.run():
        pass
    return trainer, scene


def test_the_photograph_stands_beside_the_picture_and_what_is_wrong(tmp_path: Path):
    trainer, scene = trained(40)
    path = tmp_path / "a.preview.png"
    Preview(scene, path).write(trainer)
    check_preview_target(path, force=True)
    photograph, rendered, error = np.split(np.asarray(Image.open(path)), 3, axis=1)
    rgba = scene.test.images[1] / 255
    over_white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
    assert np.abs(photograph / 255 - over_white).max() < 0.01
    assert rendered.shape == photograph.shape and error.max() > 0


def test_without_a_test_split_a_view_that_is_kept_apart_is_shown(tmp_path: Path):
    scene = demo_scene(size=16, n_train=40, n_test=1)
    train = replace(scene, test=scene.test.some([]))
    camera = Preview(train, tmp_path / "a.preview.png")._camera
    shown = [place for place, view in enumerate(scene.train.cameras) if np.array_equal(view.c2w, camera.c2w)]
    assert set(shown) <= set(whole_views(40).tolist()) and len(shown) == 1


def test_large_pictures_are_reduced_and_written_once_a_minute(tmp_path: Path):
    trainer, scene = trained(1)
    camera = scene.test.cameras[1].resized(4 * SIDE, 2 * SIDE)
    scene.test.cameras[1], scene.test.images[1] = camera, np.zeros((2 * SIDE, 4 * SIDE, 4), np.uint8)
    path = tmp_path / "a.preview.png"
    preview = Preview(scene, path)
    preview.write = lambda trainer: path.write_bytes(b"%d" % trainer.seconds)  # type: ignore[method-assign]
    written = []
    for trainer.seconds in (1.0, 0.5 * SECONDS, 1.4 * SECONDS, 1.6 * SECONDS):
        preview.update(trainer)
        written.append(path.read_bytes() if path.exists() else b"")
    assert written == [b"", b"30", b"30", b"96"]
    assert (preview._camera.width, preview._camera.height) == (SIDE, SIDE // 2)
