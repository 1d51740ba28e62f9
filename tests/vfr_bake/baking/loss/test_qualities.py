"""Pictures of the qualities `high` and `fast`, which leave out as much work as each asset allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from player.asset.asset import Asset
from player.asset.manifest import AGREEMENT
from player.cameras.camera import Camera, orbit
from player.march.interpolation import Quality
from player.render import Renderer
from vfr_bake.baking import qualities
from vfr_bake.baking.bake import bake
from vfr_bake.baking.limits import LOOKUPS
from vfr_bake.baking.qualities import (
    ALLOWED_DB,
    SHARES,
    WORST,
    ComparedView,
    compared_views,
    fitting_qualities,
)
from vfr_bake.config import BakeConfig
from vfr_bake.training.model_file import Model


@pytest.fixture(scope="module")
def asset(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Asset:
    folder = tmp_path_factory.mktemp("qualities") / "asset"
    config = BakeConfig(
        resolution=96, feature_resolution=96, mesh_resolution=16, refine_steps=0, check_views=1
    )
    bake(model, folder, config, lambda stage, done, of: None)
    return Asset.open(folder)


@pytest.fixture
def any_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nearly all pixels be marched, because pictures so small are mostly edges."""
    monkeypatch.setattr(qualities, "MARCH", 0)


@pytest.fixture(scope="module")
def cameras(model: Model) -> list[Camera]:
    return [camera.resized(96, 80) for camera in orbit(model.cameras, 5)]


def pictures(asset: Asset, cameras: list[Camera], quality: Quality) -> list[np.ndarray]:
    with Renderer(asset) as renderer:
        return [
            renderer.render(camera, quality=quality).to_uint8().reshape(-1, 3) / 255 for camera in cameras
        ]


def views_with(asset: Asset, cameras: list[Camera], noise: float) -> list[ComparedView]:
    """Return views whose photographs are the asset's exact pictures with noise."""
    random, pixels = np.random.default_rng(0), np.arange(96 * 80)
    return [
        ComparedView(camera, pixels, exact + random.normal(0, noise, exact.shape))
        for camera, exact in zip(cameras, pictures(asset, cameras, "exact"), strict=True)
    ]


def fewest(asset: Asset) -> int:
    """Return half of the fetches of an exact picture, or the next larger number that is tried."""
    own = asset.manifest.n_fetches
    return min(n for n in (*LOOKUPS, own) if 2 * n >= own)


def lost(asset: Asset, views: list[ComparedView], quality: Quality) -> np.ndarray:
    """Return what pictures of a quality lose, [n_views] in dB, by a loop."""
    cameras = [view.camera for view in views]
    found = []
    for view, exact, other in zip(
        views, pictures(asset, cameras, "exact"), pictures(asset, cameras, quality), strict=True
    ):
        before, after = (np.mean((rgb[view.pixels] - view.photograph) ** 2) for rgb in (exact, other))
        found.append(10 * np.log10(after / before))
    return np.array(found)


@pytest.mark.usefixtures("any_share")
@pytest.mark.parametrize("noise", [0.003, 0.01, 0.03])
def test_pictures_with_the_levels_that_are_found_lose_what_is_allowed(
    asset: Asset, cameras: list[Camera], noise: float
) -> None:
    views = views_with(asset, cameras, noise)
    found = fitting_qualities(asset, views, 1.0)

    def playing(agreement: tuple[float, ...], fetches: tuple[int, ...]) -> Asset:
        played = Asset.open(asset.folder)
        manifest = replace(asset.manifest, agreement=agreement, quality_fetches=fetches)
        object.__setattr__(played, "manifest", manifest)
        return played

    def too_much(agreement: tuple[float, ...], fetches: tuple[int, ...], quality: Quality) -> bool:
        loss, allowed = lost(playing(agreement, fetches), views, quality), ALLOWED_DB[quality]
        bound = loss.mean() + 2 * loss.std(ddof=1) / np.sqrt(len(loss))
        return bool(bound > allowed or loss.max() > WORST * allowed)

    wider = tuple(levels / SHARES[1] for levels in found.agreement)
    for number, quality in enumerate(ALLOWED_DB):
        loss = lost(playing(*found), views, quality)
        assert loss.mean() <= ALLOWED_DB[quality] and loss.max() <= WORST * ALLOWED_DB[quality]
        if 0 < found.agreement[number] < AGREEMENT[False][number]:
            assert too_much(wider, (0, 0), quality), "more levels would have been allowed"
        if found.fetches[number] != fewest(asset):
            assert too_much(found.agreement, (fewest(asset),) * 2, quality), "fewer would have been allowed"


@pytest.mark.usefixtures("any_share")
def test_the_better_an_asset_the_nearer_pixels_must_agree(asset: Asset, cameras: list[Camera]) -> None:
    views = [ComparedView(camera, np.arange(96 * 80), None) for camera in cameras]
    every = [fitting_qualities(asset, views, error) for error in (1.0, 1e-3, 3e-4, 1e-9)]
    found = [qualities.agreement for qualities in every]
    assert found[0] == AGREEMENT[False] and found[-1] == (0.0, 0.0)
    assert found == sorted(found, reverse=True) and found[1] > found[2]
    assert all(high <= fast for high, fast in found)
    assert every[0].fetches == (fewest(asset),) * 2 and every[-1].fetches == (0, 0)


@pytest.mark.usefixtures("any_share")
def test_where_most_would_be_marched_rays_fetch_less_instead(
    asset: Asset, cameras: list[Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    views = [ComparedView(camera, np.arange(96 * 80), None) for camera in cameras]
    assert min(fitting_qualities(asset, views, 1.0).agreement) > 0
    monkeypatch.setattr(qualities, "MARCH", 1e9)
    monkeypatch.setattr(qualities, "FEWER", 0.0)
    found = fitting_qualities(asset, views, 1.0)
    assert found.agreement == (0.0, 0.0) and found.fetches == (fewest(asset),) * 2


@pytest.mark.usefixtures("any_share")
def test_one_view_is_trusted_less(asset: Asset, cameras: list[Camera]) -> None:
    view = ComparedView(cameras[0], np.arange(96 * 80), None)
    alone, twice = (fitting_qualities(asset, [view] * n, 1e-3) for n in (1, 2))
    assert all(a <= b for a, b in zip(alone.agreement, twice.agreement, strict=True))


def test_whole_photographs_are_compared_where_there_are_some(model: Model) -> None:
    (view,) = compared_views(model, 3)
    assert model.witnesses is not None and view.photograph is not None
    assert view.camera is model.cameras[model.witnesses.whole[0]] and len(view.pixels) == len(view.photograph)
    none = replace(model, witnesses=None)
    between = compared_views(none, 3)
    assert len(between) == 3 and all(view.photograph is None for view in between)
    masked = replace(model.witnesses, whole=np.array([len(model.witnesses.counts)], np.int32))
    assert all(view.photograph is None for view in compared_views(replace(model, witnesses=masked), 3))
    enough = -(-qualities.MOST_PIXELS // 64**2)
    assert len(compared_views(none, 1000)) == enough < 1000, "all of them would take hours"
    wide = replace(none, cameras=[camera.resized(1600, 1200) for camera in model.cameras])
    assert {(view.camera.width, view.camera.height) for view in compared_views(wide, 2)} == {(640, 480)}


def test_the_middle_of_a_large_photograph_is_compared(
    model: Model, asset: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It shows what the whole picture shows there, but for the rounding of rays."""
    (whole,) = compared_views(model, 1)
    monkeypatch.setattr(qualities, "MOST_OF_PICTURE", 1000)
    (part,) = compared_views(model, 1)
    assert 900 < part.camera.width * part.camera.height <= 1000
    assert 0 < len(part.pixels) == len(part.photograph) < len(whole.pixels)
    with Renderer(asset) as renderer:
        shown, seen = (renderer.render(view.camera).rgb.reshape(-1, 3) for view in (whole, part))
    first = (64 - part.camera.width) // 2
    number = np.arange(64 * 64).reshape(64, 64)[first : first + part.camera.height, first:][
        :, : part.camera.width
    ]
    np.testing.assert_allclose(seen, shown[number.reshape(-1)], rtol=0, atol=0.05)
    rows = np.isin(whole.pixels, number)
    assert np.array_equal(number.reshape(-1)[part.pixels], whole.pixels[rows])
    assert np.array_equal(part.photograph, whole.photograph[rows])


def test_the_asset_has_what_was_found(model: Model, asset: Asset) -> None:
    found = fitting_qualities(asset, compared_views(model, 1), 1.0)
    assert (asset.manifest.agreement, asset.manifest.quality_fetches) == found
