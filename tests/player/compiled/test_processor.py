"""Tests of what compiled code asks of a processor: LLVM's answer for others, and tests run for them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite import binding

from player.compiled.lanes import LANES
from player.compiled.processor import has_wide_registers, multiplies_bytes, multiplies_shorts, target
from player.head.dense_tiles import MULTIPLIES_BYTES
from tests.reliability.processors import REPOSITORY, SHORT, environment_of, processors, run

ARM = "aarch64-unknown-linux-gnu"


@pytest.fixture(autouse=True)
def every_target() -> None:
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()


@pytest.mark.parametrize(
    ("name", "features", "lanes", "in_quads", "in_pairs"),
    [
        ("generic", "", 8, False, False),
        ("x86-64-v2", "", 8, False, False),
        ("x86-64-v3", "", 8, False, True),
        ("haswell", "", 8, False, True),
        ("x86-64-v4", "", 16, False, True),
        ("skylake-avx512", "", 16, False, True),
        ("cascadelake", "", 16, True, True),
        ("icelake-server", "", 16, True, True),
        # no later ones: LLVM 15 (numba 0.61) would end the process over their names
        ("sapphirerapids", "", 16, True, True),
        ("alderlake", "", 8, True, True),
        ("haswell", "+avx512f", 16, False, False),
        ("haswell", "+avxvnni", 8, True, True),
        ("icelake-server", "-avx512f", 8, False, True),
        ("icelake-server", "-avx512vnni", 16, False, True),
    ],
)
def test_what_a_processor_has(name: str, features: str, lanes: int, in_quads: bool, in_pairs: bool) -> None:
    of = "x86_64-unknown-linux-gnu", name, features
    assert (16 if has_wide_registers(of) else 8) == lanes
    assert multiplies_bytes(4 * lanes, of) == in_quads
    assert multiplies_shorts(4 * lanes, of) == in_pairs


@pytest.mark.parametrize("name", ["generic", "apple-m1", "neoverse-n1", "neoverse-v2"])
def test_what_arm_has(name: str) -> None:
    of = ARM, name, "+neon"
    assert not has_wide_registers(of)
    for n in (32, 64):
        assert not multiplies_bytes(n, of) and not multiplies_shorts(n, of)


def asked(**settings: str) -> str:
    program = (
        "from player.compiled.lanes import LANES; from player.head.dense_tiles import MULTIPLIES_BYTES; "
        "print(LANES, MULTIPLIES_BYTES)"
    )
    environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA_CPU")}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment | settings,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_numba_s_own_settings_are_obeyed() -> None:
    """Features that numba was told not to use are not used."""
    here = f"{LANES} {MULTIPLIES_BYTES}"
    if "NUMBA_CPU_NAME" not in os.environ:
        assert asked() == here
        assert target()[1] == binding.get_host_cpu_name()
    assert asked(NUMBA_CPU_NAME="generic") == "8 False"
    assert asked(NUMBA_CPU_NAME="x86-64-v2", NUMBA_CPU_FEATURES="") == "8 False"
    assert asked(NUMBA_CPU_NAME="x86-64-v3", NUMBA_CPU_FEATURES="") == "8 True"
    assert asked(NUMBA_CPU_FEATURES="+avx2,-avx512f", NUMBA_CPU_NAME="x86-64-v2") == "8 True"
    assert asked(NUMBA_CPU_NAME="cascadelake", NUMBA_CPU_FEATURES="") == "16 True"


@pytest.mark.parametrize("name", processors())
def test_compiled_code_is_right_on_lesser_processors(name: str, tmp_path: Path, printed: Path) -> None:
    cache = printed / "cache" if name == PRINTED_FOR else tmp_path
    done = run(name, SHORT, str(cache))
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\d\d+ passed", done.stdout) and "skipped" not in done.stdout


PRINTED_FOR = "x86-64-v2"
PRINTED = """
import sys
from pathlib import Path
import numpy as np
from exporters.head.onnx_head import head_onnx
from player.head import compiled as head_compiled
from player.compiled import march as march_compiled
from player.compiled import pixels as pixels_compiled
from player.asset.asset import Asset
from player.head.head import Head
from player.render import render
from player.cameras.transforms import read_cameras
from tests.exporters.head.test_onnx_head import random_head
from tests.player.march.contracted_scene import contracted_grid
from tests.player.march.test_contracted_march import bumps, some_rays

folder, out = Path(sys.argv[1]), Path(sys.argv[2])
asset = Asset.open(folder)
render(asset, read_cameras(folder / "cameras.json")[0], march="numba")
march_compiled.march(contracted_grid(bumps, lambda x: x[:, 0] < 4), *some_rays(20), 3)
(out / "head.onnx").write_bytes(head_onnx(random_head(8), [(-1.0, 1.0)] * 4))
head = Head((out / "head.onnx").read_bytes(), 8, compiled=True)
head(np.zeros((9, 8), np.float32), np.ones((9, 3), np.float32))
for module in (head_compiled, march_compiled, pixels_compiled):
    for name, function in vars(module).items():
        if hasattr(function, "inspect_llvm"):
            for number, text in enumerate(function.inspect_llvm().values()):
                (out / f"{module.__name__}-{name}-{number}.ll").write_text(text)
"""


@pytest.fixture(scope="module")
def printed(shells_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write what numba hands to LLVM for PRINTED_FOR, a file per function; "cache" has the compiled code."""
    folder = tmp_path_factory.mktemp("printed")
    subprocess.run(
        [sys.executable, "-c", PRINTED, str(shells_folder), str(folder)],
        env=environment_of(PRINTED_FOR, str(folder / "cache")), cwd=REPOSITORY, check=True,
    )  # fmt: skip
    return folder


def test_code_for_arm_is_its_own(printed: Path) -> None:
    """What numba hands to LLVM, with vectors of eight, becomes code for AArch64 that has that processor's
    fused multiply-adds on registers, and no instruction of another one."""
    machine = binding.Target.from_triple(ARM).create_target_machine(cpu="generic", features="+neon", opt=2)
    fused: dict[str, int] = {}
    for path in printed.glob("*.ll"):
        text = path.read_text()
        assert "llvm.x86" not in text
        text = re.sub(r"^target triple = .*$", f'target triple = "{ARM}"', text, flags=re.MULTILINE)
        text = re.sub(r"^target datalayout = .*$", "", text, flags=re.MULTILINE)
        module = binding.parse_assembly(text)
        module.data_layout = str(machine.target_data)
        of = path.name.split("-")[0]
        found = re.findall(r"\tfmla\tv\d+\.4s", machine.emit_assembly(module))
        fused[of] = fused.get(of, 0) + len(found)
    assert fused["player.compiled.march"] >= 16 and fused["player.head.compiled"] >= 8, fused
