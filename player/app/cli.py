"""`vfr-play`: an asset in a browser, to pictures, or to words."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from player.app.commands import run
from player.app.options import parse
from player.errors import VfrError


def main(argv: list[str] | None = None) -> int:
    """Run `vfr-play`; returns the exit code, those of `player.app.commands.run` and 2 for wrong usage."""
    try:
        return run("vfr-play", lambda: _run(parse(argv)))
    except SystemExit as leave:  # argparse has printed why
        return leave.code if isinstance(leave.code, int) else 2


def _run(arguments: argparse.Namespace) -> int:
    if arguments.check:
        return _check(arguments)
    if arguments.info:
        return _info(arguments)
    if arguments.output is None:
        return _view(arguments)
    return _play(arguments)


def _view(arguments: argparse.Namespace) -> int:
    from player.viewer.server import serve

    serve(arguments)
    return 0


def _play(arguments: argparse.Namespace) -> int:
    from player.app.play import kept, play

    try:
        figures, sentence = play(arguments, lambda text: print(f"vfr-play: {text}", file=sys.stderr))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(kept(arguments.output, arguments.format)) from None
    _write_json(arguments.json, figures)
    if arguments.json != "-":
        print(sentence)
    return 0


def _write_json(target: str | None, document: dict[str, Any]) -> None:
    if target is None:
        return
    text = json.dumps(document, indent=1, sort_keys=True) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return
    from player.files.files import write_bytes

    write_bytes(Path(target), text.encode())


def _check(arguments: argparse.Namespace) -> int:
    from player.asset.asset import Asset, checksums, read_manifest
    from player.asset.unpacking import check_total
    from player.files.memory import allowed_bytes
    from player.head.head import read_head_file
    from player.terminal import printable

    manifest = read_manifest(arguments.asset)
    check_total(arguments.asset, manifest, allowed_bytes(arguments.max_memory))
    results = {}
    for name, error in checksums(arguments.asset, manifest):
        results[name] = "ok" if error is None else str(error)
        if arguments.json != "-":
            found = "" if error is None else f"  {printable(str(error))}"
            print(f"{'ok    ' if error is None else 'FAILED'}  {name}{found}")
    failed = sum(result != "ok" for result in results.values())
    _write_json(arguments.json, {"ok": not failed, "files": results})
    if failed:
        raise VfrError(f"{arguments.asset}: {failed} of {len(results)} files failed")
    # the checksums hold; now the content
    asset = Asset.open(arguments.asset, max_memory=arguments.max_memory)
    read_head_file(asset.path("head.onnx"), manifest.n_channels)
    return 0


def _info(arguments: argparse.Namespace) -> int:
    from player.app.info import facts, page
    from player.asset.asset import Asset

    asset = Asset.open(arguments.asset, max_memory=arguments.max_memory)
    known = facts(asset)
    if arguments.json is not None:
        _write_json(arguments.json, known)
    if arguments.json != "-":
        from player.terminal import picture_lines

        print("\n".join([*picture_lines(asset, sys.stdout), *page(arguments.asset, asset.manifest, known)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
