"""Videos under names that FFmpeg understands in other ways."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from player.app.video import read_video_key, write_video


@pytest.mark.extra
@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
def test_a_relative_name_with_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_video(Path("12:30.mp4"), [np.zeros((48, 64, 3), np.uint8)] * 2, 30, "key")
    assert read_video_key(Path("12:30.mp4")) == "key"
    assert [path.name for path in tmp_path.iterdir()] == ["12:30.mp4"]
