"""A page that decodes a scene and draws what it is asked for, opened from a disk without a network."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.page.page import data_elements, page_script, web_files
from player.page.scene_files import scene_files

MAIN = """
import { installApi } from "./api.js";
import { loadScene } from "./loader.js";
import { compositeSource, headSource, LAYERS, marchSource } from "./program.js";
import { Renderer } from "./renderer.js";

const base64 = (array) => {
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength), parts = [];
  for (let i = 0; i < bytes.length; i += 8190) {
    parts.push(btoa(String.fromCharCode(...bytes.subarray(i, i + 8190))));
  }
  return parts.join("");
};

const times = (globalThis.times = {});
async function made() {
  const canvas = document.getElementById("canvas");
  let renderer = null;
  for await (const scene of loadScene(() => {})) {
    if (scene.grid) times.decoded = performance.now();
    renderer ??= await Renderer.create(canvas, scene);
    times.compiled ??= performance.now();
    if (scene.grid) renderer.replace(scene);
  }
  times.uploaded = performance.now();
  return (globalThis.renderer = renderer);
}

installApi(made());
globalThis.picture = async (view) => base64((await vfr.render(view)).rgba);
globalThis.counts = async (view) => {
  const { fetches, nHits } = await renderer.count(view);
  return { fetches: base64(fetches), nHits };
};
globalThis.arrays = () => {
  const grid = { ...renderer.scene.grid };
  for (const name of ["table", "density", "owners", "columns", "features"]) grid[name] = base64(grid[name]);
  return grid;
};
globalThis.sources = () => {
  const { scene, mostSteps } = renderer;
  const march = (settings) => marchSource(scene, { mostSteps, ...settings });
  const layers = LAYERS.map((layer) => march({ layer }));
  const counting = march({ layer: "colour", counting: true });
  return [...layers, counting, headSource(scene).source, compositeSource()];
};
"""


def render_page(asset: Asset) -> bytes:
    """Return a page with a canvas that decodes `asset` and draws."""
    script = page_script({**web_files(), "main.js": MAIN})
    head = "<!doctype html><meta charset=utf-8><canvas id=canvas width=64 height=64></canvas>"
    element = f'<script type="module" id="script">{script}</script>\n'
    return (head + element).encode() + data_elements(scene_files(asset))


class RenderPage:
    """An open page of an asset. `said` collects what it logs, `asked` what it requests besides itself."""

    def __init__(self, browser: Browser, asset: Asset, path: Path) -> None:
        path.write_bytes(render_page(asset))
        self._context = browser.new_context(offline=True)
        self.page: Page = self._context.new_page()
        self.page.set_default_timeout(300_000)
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())
        self.page.evaluate("() => vfr.ready")
        self.asked = [url for url in self.asked if not url.startswith("blob:") and url != path.as_uri()]

    def picture(self, camera: Camera, **settings: Any) -> np.ndarray:
        """Render a picture: [h, w, 4] uint8, straight alpha."""
        found = self.page.evaluate("view => picture(view)", view_of(camera) | settings)
        return np.frombuffer(base64.b64decode(found), np.uint8).reshape(camera.height, camera.width, 4)

    def array(self, text: str, kind: type[np.generic]) -> np.ndarray:
        return np.frombuffer(base64.b64decode(text), kind)

    def close(self) -> None:
        self._context.close()


def view_of(camera: Camera) -> dict[str, Any]:
    """Return a camera as `vfr.render` takes it."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {"c2w": camera.c2w.reshape(-1).tolist(), **{name: getattr(camera, name) for name in names}}
