"""The page in Firefox, driven by WebDriver BiDi (https://w3c.github.io/webdriver-bidi), which Firefox speaks
over a web socket; Playwright can only drive its own build of Firefox. Firefox gets a virtual screen (Xvfb),
because without a screen it has no WebGL on the processor."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from player.cameras.camera import Camera
from tests.player.page.render_page import view_of

SECONDS = 300.0
"""Longest wait, in seconds: a busy machine takes long to compile the shaders for its processor."""
PREFERENCES = {"webgl.force-enabled": "true", "network.captive-portal-service.enabled": "false"}
QUIET = ("data:", "blob:", "resource:", "chrome:", "about:")
"""Beginnings of addresses that are answered within the browser."""

PICTURE = """async (view) => {
  const { rgba } = await vfr.render(view);
  return Array.from(rgba, (value) => String.fromCharCode(value)).join("");
}"""


class FirefoxPage:
    """An open page in Firefox."""

    def __init__(self, socket: Connection, path: Path) -> None:
        self._socket, self._number = socket, 0
        self.said: list[str] = []
        self.asked: list[str] = []
        self._command("session.new", capabilities={})
        self._command("session.subscribe", events=["log.entryAdded", "network.beforeRequestSent"])
        self._context = self._command("browsingContext.getTree")["contexts"][0]["context"]
        self._command("browsingContext.navigate", context=self._context, url=path.as_uri(), wait="complete")
        self.asked = [url for url in self.asked if url != path.as_uri()]

    def _command(self, method: str, **params: Any) -> Any:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(timeout=SECONDS))
            if answer.get("id") == self._number:
                assert answer["type"] == "success", answer
                return answer["result"]
            if answer.get("method") == "log.entryAdded":
                self.said.append(answer["params"]["text"])
            elif answer.get("method") == "network.beforeRequestSent":
                url = answer["params"]["request"]["url"]
                self.asked += [url] if not url.startswith(QUIET) else []

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript `expression` or of its promise: a string, a number or a bool."""
        answer = self._command(
            "script.evaluate", expression=expression, target={"context": self._context}, awaitPromise=True
        )
        assert answer["type"] == "success", answer
        return answer["result"]["value"]

    def picture(self, camera: Camera, **settings: Any) -> np.ndarray:
        """Render a picture by the page's API for programs: [h, w, 4] uint8, straight alpha."""
        text = self.evaluate(f"({PICTURE})({json.dumps(view_of(camera) | settings)})")
        return np.frombuffer(text.encode("latin-1"), np.uint8).reshape(camera.height, camera.width, 4)

    def screenshot(self) -> bytes:
        """Return a screenshot of the page as PNG."""
        return base64.b64decode(
            self._command("browsingContext.captureScreenshot", context=self._context)["data"]
        )


@contextmanager
def firefox_page(path: Path, folder: Path) -> Iterator[FirefoxPage]:
    """Open the page at `path` in a Firefox that keeps its profile in `folder`."""
    for program in ("firefox-esr", "Xvfb"):
        if shutil.which(program) is None:
            pytest.fail(f"{program} is missing: make other-programs")
    folder.mkdir()
    lines = [f'user_pref("{name}", {value});\n' for name, value in PREFERENCES.items()]
    (folder / "user.js").write_text("".join(lines))
    command = ["xvfb-run", "-a", "firefox-esr", "--no-remote", "--profile", str(folder)]
    command += ["--remote-debugging-port", "0", "--window-size", "480,360"]
    environment = os.environ | {"LIBGL_ALWAYS_SOFTWARE": "1", "HOME": str(folder)}
    browser = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment, start_new_session=True
    )
    try:
        with connect(_address(folder), max_size=None) as socket:
            yield FirefoxPage(socket, path)
    finally:
        os.killpg(browser.pid, 15)
        browser.wait(SECONDS)


def _address(folder: Path) -> str:
    """Return the address at which Firefox listens, once Firefox has written it into its profile."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        try:
            server = json.loads((folder / "WebDriverBiDiServer.json").read_text())
        except (FileNotFoundError, json.JSONDecodeError):  # not written yet, or half written
            time.sleep(0.1)
        else:
            return f"ws://{server['ws_host']}:{server['ws_port']}/session"
    pytest.fail("Firefox did not begin to listen")
