"""A page that decodes a scene and tells what it found, opened from a disk in a browser without a network."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser

from player.asset.asset import Asset
from player.asset.pyramid import PyramidValues
from player.page.page import data_elements, page_script, web_files

MAIN = """
import { loadScene } from "./loader.js";

async function digest(array) {
  const found = await (globalThis.subtle ?? crypto.subtle).digest("SHA-256", array.slice());
  return Array.from(new Uint8Array(found), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

async function described({ n_channels, levels, values, firstRows }) {
  const found = [];
  for (const { coords, cells } of levels) found.push([await digest(coords), await digest(cells)]);
  const kind = values.constructor.name;
  return { n_channels, levels: found, values: await digest(values), kind, firstRows };
}

globalThis.found = (async () => {
  const scenes = [], progress = [];
  let error = null, cameras = null, head = null;
  try {
    for await (const scene of loadScene(({ done, total }) => progress.push(done / total))) {
      ({ cameras, head } = scene);
      if (!scene.grid) continue;
      const { grid } = scene;
      const [densities, features] = [await described(grid.densities), await described(grid.features)];
      scenes.push({ n_parts: scene.n_parts, problem: scene.problem, densities, features });
    }
  } catch (thrown) {
    error = thrown.message;
  }
  return { scenes, progress, error, cameras, head };
})();
"""

ARRANGED = """
const coordOf = (key) => [key >> 18, (key >> 9) & 511, key & 511];
const coordsOf = (keys) => Uint16Array.from([...keys].flatMap(coordOf));
const plain = ({ levels, n_channels, stride, values, firstRows }) => ({
  n_channels, values: values.filter((_, i) => i % stride < n_channels), firstRows,
  levels: levels.map((bricks) => ({ coords: coordsOf(bricks.keys), cells: bricks.masks })),
});
export const arrangeDensities = (manifest, densities) => ({ densities: plain(densities) });
export const arrangeFeatures = (manifest, features) => ({
  features: plain(features), handedOver: features.values,
});
"""
"""JavaScript in place of `grid.js` that keeps what is decoded as it is. As `grid.js` does, it also hands over
the decoder's own array of the features, which a worker then loses to the page."""


def decoder_page(files: Mapping[str, bytes], before: str = "", policy: str = "", main: str = MAIN) -> bytes:
    """Return a page that decodes the data `files` in it; `before` runs first, in the page and its worker."""
    modules = {**web_files(), "main.js": main, "grid.js": ARRANGED}
    text = before + page_script(modules)
    script = f'<script type="module" id="script">{text}</script>\n'
    return f"<!doctype html>{policy}{script}".encode() + data_elements(files)


def decoded(browser: Browser, path: Path) -> Any:
    """Open the page at `path` and return what it found; check that it requests nothing and logs nothing."""
    context = browser.new_context(offline=True)
    page = context.new_page()
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    found = page.evaluate("() => globalThis.found")
    context.close()
    assert not said
    assert [url for url in asked if not url.startswith("blob:")] == [path.as_uri()]
    return found


def described(stored: PyramidValues) -> dict[str, Any]:
    """Return what the page should find of a grid, by the player's own reader."""

    def digest(array: np.ndarray) -> str:
        return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()

    levels = [[digest(b.coords.astype("<u2")), digest(b.masks.astype("<u8"))] for b in stored.pyramid.levels]
    kind = {"uint8": "Uint8Array", "int8": "Int8Array"}[stored.values[0].dtype.name]
    values = digest(np.concatenate(stored.values))
    first_rows = stored.first_rows.tolist()
    return {
        "n_channels": stored.n_channels, "levels": levels, "values": values, "kind": kind,
        "firstRows": first_rows,
    }  # fmt: skip


def expected(asset: Asset) -> dict[str, Any]:
    """Return the densities and features that a page of the asset should find."""
    return {grid: described(getattr(asset.arrays, grid)) for grid in ("densities", "features")}


def without_problem(scene: dict[str, Any]) -> dict[str, Any]:
    """Return only the densities and features that a page found."""
    return json.loads(json.dumps({grid: scene[grid] for grid in ("densities", "features")}))
