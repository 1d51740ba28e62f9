"""What `vfr-bake` says before it begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from vfr_bake.cli import bake_main


@pytest.mark.parametrize(("given", "warns"), [("5", True), ("3", False)])
def test_more_memory_than_there_is_is_told(
    given: str,
    warns: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("vfr_bake.commands.bake.available_bytes", lambda: 4_000_000_000)
    assert bake_main([str(tmp_path / "none.pt"), str(tmp_path / "out"), "--max-memory", given]) == 1
    told = capsys.readouterr().err
    assert ("warning: --max-memory 5 is more than the 4.0 GB that there are" in told) == warns
    assert "none.pt: no such file" in told
