"""An asset as one HTML file that plays it in any browser, or as a folder for a web server.

Both have the same `index.html`. It contains the modules of `player/page/web`, joined to one script
(`player.page.modules`), compressed by zlib and stored as text (`player.page.text_bytes`). The one file also
contains the poster and the data (`player.page.scene_files`); in the folder these are files beside it. The
page is ASCII throughout, so that it reads the same whatever charset a server claims.

Files of `player/page/web`:

- `*.js` are ES modules that keep to the rules of `player.page.modules`: `main.js` starts the page,
  `worker.js` decodes the data, and `boot.js` unpacks the script of the page and runs it. `scene` has those
  that load and decode the data, `drawing` those that draw a picture, and `viewer` those that people use.
- `shaders/*.glsl` are shaders. They are joined to the module `shaders.js`, which is written here: `import {
  shaders } from "../shaders.js";`, then `shaders["march.glsl"]`.
- `style.css` is the style.
- `index.html` is the page. In it, `{{title}}` and `{{advice}}`, which says what to do where the data are not
  beside the page, are replaced by text, `{{poster}}` by an address for `src`, and `{{policy}}`, `{{style}}`,
  `{{script}}`, `{{viewer}}` and `{{data}}` by whole elements.

The compressed script is the element with the id `viewer`. `boot.js` unpacks it to an element with the id
`script`, whose text the worker runs as well. In the one file, each file of the data is an element
`<script type="text/plain" data-file="NAME">`: the manifest as it is, with its SHA-256 in `data-sha256`, and
the others as text. `boot.js` stands in the head and runs when the page has arrived, so that it can tell where
the page is cut short.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Mapping
from importlib import resources
from typing import NamedTuple

from player.asset.asset import Asset
from player.asset.manifest import NAME
from player.errors import ConfigError
from player.page.gpu_memory import MOST_CHANNELS, MOST_DECODING_BYTES, decoding_bytes, gpu_bytes
from player.page.modules import joined, without_comments
from player.page.poster import poster_bytes
from player.page.scene_files import scene_files
from player.page.text_bytes import text_of_bytes
from player.render import March

INDEX = "index.html"
STYLE = "style.css"
BOOT = "boot.js"
POSTER = "poster.jpg"
_ADVICE_OF_MANY_FILES = (
    "Open this folder through a web server: type python -m http.server in it, then open "
    "http://localhost:8000/. Or export the scene as one file, whose name ends in .html. On a server, the "
    "folder's address must end in a slash."
)
MAX_GPU_MB = 512
"""Megabytes of graphics memory that an exported page may take, unless more are allowed."""
_POLICY = (
    "default-src 'none'; script-src {script}; style-src {style}; img-src data: blob: {img}; "
    "worker-src blob:; connect-src {connect}; base-uri 'none'; form-action 'none'"
)


class WebPage(NamedTuple):
    """The files of an asset's page, and how much memory they take."""

    files: dict[str, bytes]
    """Content by name: `index.html` alone for one file."""
    viewer_bytes: int
    """Bytes of everything but the scene's data and the poster."""
    gpu_bytes: int
    """Bytes of graphics memory that the page will take."""


def page(
    asset: Asset,
    title: str | None = None,
    max_gpu_mb: int | None = None,
    n_threads: int | None = None,
    march: March = "auto",
) -> bytes:
    """Make one HTML file, in ASCII, which loads nothing else.

    Args:
        asset: an open asset. The page shows the parts with which it was opened.
        title: the page's title; the name of the asset's folder if None.
        max_gpu_mb: megabytes of graphics memory that the page may take; any number if None. Each page finds
            out by itself whether the visitor's device has enough.
        n_threads, march: those of `player.render.render`, for the picture that the page shows at first.

    Raises:
        ConfigError: the page takes more graphics memory, or more memory than browsers give a page, or the
            asset has more channels than browsers can draw.
        FormatError: a file of the asset is broken, or a part is missing.
        MissingExtraError: `march` is "numba", which is not installed or does not run here.

    >>> page(Asset.open("out/"))[:15]
    b'<!doctype html>'
    """
    return page_of_one_file(asset, title, max_gpu_mb, n_threads, march).files[INDEX]


def page_of_one_file(
    asset: Asset,
    title: str | None = None,
    max_gpu_mb: int | None = None,
    n_threads: int | None = None,
    march: March = "auto",
) -> WebPage:
    """Make the same file as `page`; returns it with its sizes."""
    n_gpu, files = _checked_gpu_bytes(asset, max_gpu_mb), scene_files(asset)
    poster = base64.b64encode(poster_bytes(asset, n_threads, march)).decode()
    before, behind = _around_data(
        asset, title, poster=f"data:image/jpeg;base64,{poster}", advice="", img="", connect="'none'"
    )
    n_around = len(before + data_elements(dict.fromkeys(files, b"")) + behind) - len(poster)
    return WebPage({INDEX: before + data_elements(files) + behind}, n_around, n_gpu)


def page_of_many_files(asset: Asset, title: str | None = None, max_gpu_mb: int | None = None) -> WebPage:
    """Make the files of a folder for a web server. Its page, `index.html`, shows the scene as soon as the
    first part is loaded. `title`, `max_gpu_mb` and the errors are those of `page`.

    >>> files = page_of_many_files(Asset.open("out/")).files
    >>> {"index.html", "poster.jpg", "part_0.bin"} <= set(files)
    True
    """
    n_gpu, files = _checked_gpu_bytes(asset, max_gpu_mb), scene_files(asset)
    poster = poster_bytes(asset)
    # Another poster has another address: a browser may have kept that of an earlier export.
    address = f"{POSTER}?v={hashlib.sha256(poster).hexdigest()[:8]}"
    index = b"".join(
        _around_data(
            asset, title, poster=address, advice=_ADVICE_OF_MANY_FILES, img="'self'", connect="'self'"
        )
    )
    return WebPage({INDEX: index, POSTER: poster, **files}, len(index), n_gpu)


def _around_data(
    asset: Asset, title: str | None, *, poster: str, advice: str, img: str, connect: str
) -> tuple[bytes, bytes]:
    """Return `index.html` as what is before the data and what is behind them."""
    sources = web_files()
    style, script = _escaped_style(sources[STYLE] + _behind(asset)), page_script(sources)
    boot, packed = page_script(sources, BOOT, BOOT), zlib.compress(script.encode(), 9)
    policy = _POLICY.format(
        script=f"{_hash(boot)} {_hash(script)}", style=_hash(style), img=img, connect=connect
    )
    viewer = text_of_bytes(packed).decode()
    filled = {
        "policy": f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        "title": html.escape(asset.folder.resolve().name if title is None else title),
        "style": f"<style>{style}</style>",
        "poster": poster,
        "advice": advice,
        "script": f'<script type="module">{boot}</script>',
        "viewer": f'<script type="text/plain" id="viewer" data-bytes="{len(packed)}">{viewer}</script>',
    }
    halves = (_filled(half, filled) for half in sources[INDEX].split("{{data}}"))
    before, behind = (half.encode("ascii", "xmlcharrefreplace") for half in halves)
    return before, behind


def is_site_file(name: str) -> bool:
    """Return whether `page_of_many_files` writes a file of that name, or wrote it when the modules and the
    style were files of the folder.

    >>> is_site_file("main.js"), is_site_file("part_3.bin"), is_site_file("mine.js")
    (True, True, False)
    """
    data = r"manifest\.json|cameras\.json|head\.(json|bin)|part_\d+\.bin"
    return name in web_files() or name == POSTER or re.fullmatch(data, name) is not None


def _checked_gpu_bytes(asset: Asset, max_gpu_mb: int | None) -> int:
    n_channels = asset.manifest.n_channels
    if n_channels > MOST_CHANNELS:
        raise ConfigError(
            f"{asset.folder}: channels: expected at most {MOST_CHANNELS}, which browsers can draw, got "
            f"{n_channels}: bake it with fewer (vfr-bake --n-channels)"
        )
    needed = decoding_bytes(asset)
    if needed > MOST_DECODING_BYTES:
        raise ConfigError(
            f"{asset.folder}: memory to unpack the scene: expected at most {MOST_DECODING_BYTES // 10**6} "
            f"MB, which browsers give a page, got {-(-needed // 10**6)} MB: bake it smaller "
            "(vfr-bake --preset)"
        )
    found = gpu_bytes(asset)
    if max_gpu_mb is not None and found > max_gpu_mb * 1_000_000:
        raise ConfigError(
            f"{asset.folder}: graphics memory: expected at most {max_gpu_mb} MB, got "
            f"{-(-found // 10**6)} MB: bake it smaller (vfr-bake --preset), or allow more (--max-gpu-mb)"
        )
    return found


def _behind(asset: Asset) -> str:
    """Return a CSS rule that shows the scene's background beside the poster."""
    red, green, blue = (round(255 * value) for value in asset.manifest.background)
    return f"#stage {{ background: rgb({red}, {green}, {blue}); }}\n"


def web_files() -> dict[str, str]:
    """Read the modules, the style and the page itself, by file name, without comments and needless spaces,
    and with the shaders as `shaders.js`."""
    top = resources.files("player.page") / "web"
    folders = [top, *(entry for entry in top.iterdir() if entry.is_dir())]
    entries = [entry for folder in folders for entry in folder.iterdir() if entry.is_file()]
    files = {file.name: file.read_text(encoding="utf-8") for file in entries}
    found = {name: _stripped(name, text) for name, text in sorted(files.items())}
    shaders = {name: found.pop(name) for name in list(found) if name.endswith(".glsl")}
    found["shaders.js"] = f"export const shaders = {json.dumps(shaders, indent=0)};\n"
    return found


def data_elements(files: Mapping[str, bytes]) -> bytes:
    """Make the elements of a page that hold the files of `scene_files`."""
    texts = {
        name: data.replace(b"<", b"\\u003c") if name == NAME else text_of_bytes(data)
        for name, data in files.items()
    }
    digest = hashlib.sha256(texts[NAME]).hexdigest()
    attributes = {NAME: f' data-sha256="{digest}"'.encode()}
    return b"".join(
        b'<script type="text/plain" data-file="%s"%s>%s</script>\n'
        % (name.encode(), attributes.get(name, b""), text)
        for name, text in texts.items()
    )


def _stripped(name: str, text: str) -> str:
    if name.endswith(".css"):
        return re.sub(r"(?<=[{}:;,])\s+|\s+(?={)", "", without_comments(text))
    return without_comments(text) if name.endswith((".js", ".glsl")) else text


def page_script(files: Mapping[str, str], begin: str = "main.js", worker: str = "worker.js") -> str:
    """Join those modules of `web_files` that a page needs to one script, in ASCII."""
    script = joined(files, begin, worker)
    script = re.sub(r"</(?=script)", r"<\\/", script, flags=re.IGNORECASE).replace("<!--", r"<\!--")
    units = script.encode("utf-16-le")
    codes = (int.from_bytes(units[i : i + 2], "little") for i in range(0, len(units), 2))
    return "".join(chr(code) if code < 128 else f"\\u{code:04x}" for code in codes)


def _escaped_style(style: str) -> str:
    return "".join(letter if letter.isascii() else f"\\{ord(letter):x} " for letter in style)


def _hash(text: str) -> str:
    """Return the hash by which a Content-Security-Policy names an element with this text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _filled(index: str, values: Mapping[str, str]) -> str:
    """Fill in each `{{name}}` of the page; what is filled in is not searched again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], index)
