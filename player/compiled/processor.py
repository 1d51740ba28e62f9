"""Features of the processor that numba compiles for: this machine's, or the one that NUMBA_CPU_NAME and
NUMBA_CPU_FEATURES name.

LLVM knows which processor has which instructions, but cannot be asked directly. So the assembly is inspected
that it makes of a few lines which every processor can run: sums of many numbers show how wide the registers
are, a sum of products of bytes shows whether four of them are added up at once. Only compiled code imports
this module.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

from llvmlite import binding
from numba.core import registry

_SUM = """
define <16 x float> @sum(<16 x float> %a, <16 x float> %b) {
  %c = fadd <16 x float> %a, %b
  ret <16 x float> %c
}
"""
_SHORT_SUM = """
define <N x i16> @sum(<N x i16> %a, <N x i16> %b) {
  %c = add <N x i16> %a, %b
  ret <N x i16> %c
}
"""
_DOT = """
declare i32 @llvm.vector.reduce.add.vNi32(<N x i32>)
define i32 @dot(<N x i8> %a, <N x i8> %b) {
  %x = zext <N x i8> %a to <N x i32>
  %y = sext <N x i8> %b to <N x i32>
  %p = mul nsw <N x i32> %x, %y
  %s = call i32 @llvm.vector.reduce.add.vNi32(<N x i32> %p)
  ret i32 %s
}
"""
_REGISTERS = {32: "ymm", 64: "zmm"}
"""Names of registers, by the number of bytes that they hold."""


@lru_cache(maxsize=1)
def target() -> tuple[str, str, str]:
    """Return what numba tells LLVM to compile for: the kind of machine (a triple), the processor's name, and
    the features in which the processor differs from that name ("+avx2,-avx512f")."""
    context: Any = registry.cpu_target.target_context
    return context.codegen().magic_tuple()


def has_wide_registers(of: tuple[str, str, str] | None = None) -> bool:
    """Return whether registers hold sixteen float32 (AVX-512), on the processor that numba compiles for or on
    that of another target, `of`."""
    return bool(re.search(r"vaddps\s.*zmm", _assembly(_SUM, of or target())))


def multiplies_bytes(n: int, of: tuple[str, str, str] | None = None) -> bool:
    """Return whether one instruction (VNNI) multiplies `n` bytes, 32 or 64, by as many others and adds up the
    products in groups of four."""
    module = _DOT.replace("N", str(n))
    return bool(re.search(rf"vpdpbusd\s.*{_REGISTERS[n]}", _assembly(module, of or target())))


def multiplies_shorts(n: int, of: tuple[str, str, str] | None = None) -> bool:
    """Return whether registers hold `n` bytes, 32 or 64, of integers of 8 and 16 bits (AVX2 and AVX-512BW).
    Then two instructions multiply as many bytes and add up the products in groups of four, if sums of two
    products fit into 16 bits."""
    module = _SHORT_SUM.replace("N", str(n // 2))
    return bool(re.search(rf"vpaddw\s.*{_REGISTERS[n]}", _assembly(module, of or target())))


def _assembly(module: str, of: tuple[str, str, str]) -> str:
    triple, name, features = of
    machine = binding.Target.from_triple(triple).create_target_machine(cpu=name, features=features, opt=2)
    return machine.emit_assembly(binding.parse_assembly(module))
