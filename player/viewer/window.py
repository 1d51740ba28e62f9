"""One browser window: its controls, its camera, and the thread that renders for it."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from player.cameras.camera import Camera
from player.cameras.keyframes import smooth_path
from player.cameras.nerfstudio import write_camera_path
from player.cameras.rotations import OPENGL_FROM_OPENCV, quaternion, rotation_matrix
from player.errors import VfrError
from player.files.images import png_bytes
from player.march.bounds import BLOCK
from player.render import Background, Frame, Quality, Renderer
from player.terminal import printable
from player.viewer.layers import LAYERS, layer_picture
from player.viewer.pages import page_path
from player.viewer.resolution import STILL_SECONDS, Pace, fitted

if TYPE_CHECKING:
    from player.viewer.guard import GuardedConnection
    from player.viewer.messages import Check

PATH_FPS = 30
STRIP_PIXELS = 50_000
"""Least number of pixels of a strip, about. A full-size picture is rendered in strips, so that it can be
given up between two of them; each has as many pixels as a picture while the camera moves, if that is more."""
MOST_PIXELS = 3840 * 2160
"""Most pixels of a full-size picture, whatever size a window says it has."""
MOST_SIDE = 8192
"""Largest width or height in pixels that a window is believed to have."""
MOST_VIEWS = 200
"""Most views of a recorded path."""
HANDED_OVER_SECONDS = 0.2
"""Seconds after which viser has handed a file to the connection."""


FIRST_DISTANCE = 4.0
"""Distance of the first view from the focus in viser's units, about that of an object's cameras."""

QUALITIES = ("fast while moving", "exact", "high", "fast")
"""The options of the quality control. With the first, pictures are exact when the camera stands still."""


class PictureChoices(NamedTuple):
    """The choices of the command line for pictures; None leaves a choice to the asset or the viewer."""

    samples: int | None
    quality: Quality | None
    background: Background | None


class ViserFrame(NamedTuple):
    """The frame in which viser moves the camera. Its keys move two units a second and its zoom ends at 0.01
    units, so that scenes of every size have the same size in it."""

    focus: np.ndarray
    """Its origin in the world, [3]: the point that the cameras look at."""
    unit: float
    """Its unit in world units."""

    @classmethod
    def around(cls, focus: np.ndarray, first: Camera) -> ViserFrame:
        """Return the frame in which a first view is `FIRST_DISTANCE` units away from the focus."""
        distance = float(np.linalg.norm(first.c2w[:3, 3] - focus))
        return cls(focus, distance / FIRST_DISTANCE if distance > 0 else 1.0)

    def from_world(self, place: np.ndarray) -> np.ndarray:
        return (place - self.focus) / self.unit

    def to_world(self, place: np.ndarray) -> np.ndarray:
        return self.focus + self.unit * place


class Window:
    """The window of one client. `start` begins rendering, and `close` ends it, also when the client is
    gone."""

    def __init__(
        self,
        client: Any,
        connection: GuardedConnection,
        renderers: Sequence[Renderer],
        trained: Sequence[Camera],
        frame: ViserFrame,
        chosen: PictureChoices,
        whole: threading.Lock,
    ) -> None:
        """`whole`: a lock for rendering a full-size picture. Only one window holds it at a time, so that
        memory is needed for one such picture alone."""
        self._client = client
        self._connection = connection
        self._whole = whole
        self._saving = threading.Lock()
        self._renderers = _named(renderers)
        self._renderer = renderers[0]
        self._trained = trained
        self._viser = frame
        self._pace = Pace()
        self._views: list[Camera] = []
        self._changed = threading.Condition()
        self._version = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"vfr-view-{client.client_id}", daemon=True)
        own = self._renderer.asset.manifest
        self._add_controls(
            own.n_fetches
            if chosen.samples is None
            else min(chosen.samples, self._renderer.asset.most_samples),
            QUALITIES[0] if chosen.quality is None else chosen.quality,
            own.background if chosen.background is None else chosen.background,
        )
        client.camera.on_update(lambda _: self.touch())

    def start(self) -> None:
        """Begin rendering."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; returns at once."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def touch(self) -> None:
        """Note that something has changed, so that the picture on the screen is out of date."""
        with self._changed:
            self._version += 1
            self._changed.notify()

    # --- controls ---

    def _add_controls(self, samples: int, quality: str, background: Any) -> None:
        from player.viewer.messages import colour, one_of, pressed, within

        gui = self._client.gui
        with gui.add_folder("Picture"):
            if len(self._renderers) > 1:
                names = list(self._renderers)
                self._asset = gui.add_dropdown("Asset", names, initial_value=names[0])
                self._asset.on_update(lambda _: self._switch())
                self._takes(self._asset, one_of(names))
            self._layer = gui.add_dropdown("Show", LAYERS, initial_value="colour")
            self._samples = gui.add_slider(
                "Fetches",
                0,
                max(16, samples),
                1,
                samples,
                hint="places along a ray where features are fetched; 0: all",
            )
            self._quality = gui.add_dropdown(
                "Quality",
                QUALITIES,
                initial_value=quality,
                hint="high and fast interpolate pixels between neighbours that agree",
            )
            behind = tuple(round(255 * value) for value in background)
            self._background = gui.add_rgb("Background", behind)
            degrees = round(math.degrees(self._client.camera.fov), 1)
            self._fov = gui.add_slider("Field of view", 1.0, 150.0, 0.1, min(max(degrees, 1.0), 150.0))
            self._state = gui.add_text("Now", "", disabled=True)
            self._link = gui.add_markdown(_link(0))
        for control in (self._layer, self._samples, self._quality, self._background):
            control.on_update(lambda _: self.touch())
        self._fov.on_update(lambda _: self._set_fov())
        with gui.add_folder("Views"):
            last = len(self._trained) - 1
            self._view = gui.add_slider("Training view", 0, max(last, 1), 1, 0, disabled=last < 1)
            jump = gui.add_button("Jump to it")
            picture = gui.add_button("Screenshot")
        self._view.on_update(lambda _: self._jump())
        jump.on_click(lambda _: self._jump())
        picture.on_click(lambda _: self._screenshot())
        with gui.add_folder("Camera path"):
            record = gui.add_button("Record this view")
            self._seconds = gui.add_slider("Seconds a view", 0.5, 10.0, 0.5, 2.0)
            self._save = gui.add_button("Save path", disabled=True)
            self._clear = gui.add_button("Clear path", disabled=True)
        record.on_click(lambda _: self._record())
        self._save.on_click(lambda _: self._save_path())
        self._clear.on_click(lambda _: self._clear_path())
        self._takes(self._layer, one_of(LAYERS))
        self._takes(self._quality, one_of(QUALITIES))
        self._takes(self._background, colour)
        for slider in (self._samples, self._fov, self._view, self._seconds):
            whole = isinstance(slider.value, int)
            self._takes(slider, within(lambda slider=slider: (slider.min, slider.max), whole))
        for button in (jump, picture, record, self._save, self._clear):
            self._takes(button, pressed)

    def _takes(self, control: Any, check: Check) -> None:
        """Let the client set a control, to values that the check returns."""
        self._connection.controls[control._impl.uuid] = check

    def _switch(self) -> None:
        """Show another asset, with the number of fetches that it was baked for."""
        self._renderer = self._renderers[self._asset.value]
        self._link.content = _link(list(self._renderers).index(self._asset.value))
        n_fetches = self._renderer.asset.manifest.n_fetches
        self._samples.max = max(self._samples.max, n_fetches)
        self._samples.value = n_fetches
        self.touch()

    def _set_fov(self) -> None:
        self._client.camera.fov = math.radians(self._fov.value)
        self.touch()

    def _jump(self) -> None:
        camera = self._trained[min(self._view.value, len(self._trained) - 1)]
        handle = self._client.camera
        place, backwards = self._viser.from_world(camera.c2w[:3, 3]), camera.c2w[:3, 2]
        with self._client.atomic():
            handle.position = place
            handle.look_at = place - max(float(backwards @ place), 1e-3) * backwards
            handle.wxyz = quaternion((camera.c2w @ OPENGL_FROM_OPENCV)[:3, :3])
        self._fov.value = math.degrees(field_of_view(camera, handle.image_width, handle.image_height))
        self._set_fov()

    def _screenshot(self) -> None:
        def picture() -> bytes:
            layer = self._layer.value
            with self._whole:
                return png_bytes(layer_picture(self._frame(self._camera(), layer), layer))

        self._send_file("screenshot.png", picture)

    def _send_file(self, name: str, make: Callable[[], bytes]) -> None:
        """Send a file once the client has taken what it was sent before; clicks meanwhile do nothing."""
        if not self._saving.acquire(blocking=False):
            return
        try:
            while self._connection.n_sending and not self._closed:
                time.sleep(HANDED_OVER_SECONDS)
            if not self._closed:
                self._client.send_file_download(name, make(), save_immediately=True)
                time.sleep(HANDED_OVER_SECONDS)
        except Exception:
            if not self._closed:  # else the renderer may be closed, too, which ends a picture midway: no bug
                raise
        finally:
            self._saving.release()

    def _record(self) -> None:
        if len(self._views) < MOST_VIEWS:
            self._views.append(self._camera())
        self._show_path()

    def _clear_path(self) -> None:
        self._views.clear()
        self._show_path()

    def _show_path(self) -> None:
        n = len(self._views)
        self._save.disabled, self._clear.disabled = n < 2, n == 0
        self._save.label = f"Save path of {n} views" if n else "Save path"

    def _save_path(self) -> None:
        views, steps = list(self._views), max(1, round(self._seconds.value * PATH_FPS))
        if len(views) >= 2:  # the button is disabled, which does not keep a client from pressing it
            self._send_file(
                "camera_path.json", lambda: write_camera_path(smooth_path(views, steps), PATH_FPS)
            )

    # --- pictures ---

    def _camera(self) -> Camera:
        """Return the window's camera as it is now, in the world frame, with no more pixels than allowed."""
        seen = self._client.camera
        c2w = np.eye(4)
        c2w[:3, :3] = rotation_matrix(seen.wxyz / np.linalg.norm(seen.wxyz))
        c2w[:3, 3] = self._viser.to_world(seen.position)
        width, height = max(int(seen.image_width), 1), max(int(seen.image_height), 1)
        focal = height / 2 / math.tan(seen.fov / 2)
        camera = Camera(
            "viewer", c2w @ OPENGL_FROM_OPENCV, width, height, focal, focal, width / 2, height / 2
        )
        width, height = fitted(min(width, MOST_SIDE), min(height, MOST_SIDE), MOST_PIXELS)
        return camera.resized(width, height)

    def _frame(self, camera: Camera, layer: str, moving: bool = False) -> Frame:
        """Render a picture for `layer`; normals are computed at once, on all threads, if it shows them."""
        red, green, blue = (value / 255 for value in self._background.value)
        chosen = self._quality.value
        quality: Quality = chosen if chosen != QUALITIES[0] else "fast" if moving else "exact"
        return self._renderer.render(
            camera,
            int(self._samples.value),
            (red, green, blue),
            layers=(layer == "normals"),
            quality=quality,
        )

    def _run(self) -> None:
        version = -1
        while True:
            if not self._wait(version, None):
                return
            version = self._version
            try:
                self._show_moving()
                self._sharpen(version)
            except VfrError as error:
                if self._closed:
                    return
                self._state.value = printable(str(error))
            except Exception:
                if self._closed:  # the renderer may be closed, too, which ends a picture midway: no bug
                    return
                # a bug: it is reported, and does not end the window
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), threading.current_thread())))
                self._state.value = "failed: the terminal of vfr-play says why"

    def _wait(self, version: int, seconds: float | None) -> bool:
        """Wait for a change after `version`; returns whether there is one and the window is still open."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._version != version, seconds)
            return self._version != version and not self._closed

    def _show_moving(self) -> None:
        camera, layer = self._camera(), self._layer.value
        start = time.perf_counter()
        small = camera.resized(*self._pace.moving(camera.width, camera.height))
        picture = layer_picture(self._frame(small, layer, moving=True), layer)
        seconds = time.perf_counter() - start
        self._pace.measured(small.width * small.height, seconds)
        self._send(picture, 75, f"{small.width}x{small.height}, {seconds * 1000:.0f} ms")

    def _sharpen(self, version: int) -> None:
        """Once the camera has stood still for a moment, show a picture as large as half a second allows, then
        one of full size. Both are given up as soon as something changes."""
        if self._wait(version, STILL_SECONDS) or self._closed:
            return
        camera = self._camera()
        window = (camera.width, camera.height)
        size = self._pace.sharp(*window)
        for width, height in dict.fromkeys([size, window]):
            if not self._have_turn(version):
                return
            start = time.perf_counter()
            try:
                picture = self._in_strips(camera.resized(width, height), version)
            finally:
                self._whole.release()
            if picture is None:
                return
            seconds = time.perf_counter() - start
            self._send(picture, 95, f"{width}x{height}, {seconds * 1000:.0f} ms")

    def _have_turn(self, version: int) -> bool:
        """Wait until no other window renders a full-size picture; returns False if something changed
        meanwhile."""
        while not self._whole.acquire(timeout=0.05):
            if self._closed or self._version != version:
                return False
        return True

    def _in_strips(self, camera: Camera, version: int) -> np.ndarray | None:
        """Render the chosen layer [h, w, 3] uint8 in strips; returns None if something changed meanwhile."""
        layer = self._layer.value
        pixels = max(STRIP_PIXELS, math.prod(self._pace.moving(camera.width, camera.height)))
        rows = max(1, pixels // camera.width // BLOCK) * BLOCK  # whole blocks: the lattice continues
        frames = []
        for top in range(0, camera.height, rows):
            if self._closed or self._version != version:
                return None
            strip = replace(camera, height=min(rows, camera.height - top), cy=camera.cy - top)
            frame = self._frame(strip, layer)
            find_normals = _known(frame.normals) if layer == "normals" else None
            # without features: they are not shown, and could take more memory than all the rest
            frames.append(replace(frame, features=None, find_normals=find_normals))
        return layer_picture(_joined(frames, layer), layer)

    def _send(self, picture: np.ndarray, quality: int, state: str) -> None:
        self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=quality)
        self._state.value = state


def field_of_view(camera: Camera, width: int, height: int) -> float:
    """Return the vertical field of view in radians with which a window shows all that a camera sees, also if
    the window is narrower.

    >>> camera = Camera("", np.eye(4), 400, 300, 200.0, 200.0, 200.0, 150.0)
    >>> [round(math.tan(field_of_view(camera, *size) / 2), 2) for size in ((800, 600), (300, 600))]
    [0.75, 2.0]
    """
    across = camera.width / 2 / camera.fx * max(int(height), 1) / max(int(width), 1)
    return 2 * math.atan(max(camera.height / 2 / camera.fy, across))


def _link(index: int) -> str:
    """Return a line with the link to an asset's page."""
    return f"[The same on this device's own GPU]({page_path(index)})"


def _named(renderers: Sequence[Renderer]) -> dict[str, Renderer]:
    """Return renderers by the names of their assets' folders, or by the folders' paths if two names are the
    same."""
    folders = [renderer.asset.folder.resolve() for renderer in renderers]
    names = [printable(folder.name) for folder in folders]
    if len(set(names)) < len(names):
        names = [printable(str(folder)) for folder in folders]
    return dict(zip(names, renderers, strict=True))


def _known(normals: np.ndarray) -> Callable[[], np.ndarray]:
    """Return the function of a frame that was put together, whose normals are computed already."""
    return lambda: normals


def _joined(frames: Sequence[Frame], layer: str) -> Frame:
    """Join strips, the uppermost first, to one frame; it has normals if `layer` shows them."""

    def all_of(name: str) -> np.ndarray:
        return np.concatenate([getattr(frame, name) for frame in frames])

    normals = all_of("normals") if layer == "normals" else None
    return Frame(
        all_of("rgb"), all_of("opacity"), all_of("depth"), all_of("n_density_samples"), frames[0].background,
        find_normals=None if normals is None else _known(normals),
    )  # fmt: skip
