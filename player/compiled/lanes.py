"""Vectors of LANES numbers in registers, for code that the compiler does not vectorise by itself.

In a march, every lookup and every branch depends on the lookup before it: no compiler vectorises that. Here
the vectors are written explicitly, with Python's operators, which emit LLVM's instructions while a function
is compiled (`numba.extending.intrinsic`). Only compiled code imports this module.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from player.compiled.processor import has_wide_registers

LANES = 16 if has_wide_registers() else 8
"""Numbers in a vector: as many as one register of the processor holds, or as two hold where one holds
four."""

FLOAT, INT, LONG, BYTE = ir.FloatType(), ir.IntType(32), ir.IntType(64), ir.IntType(8)
SHORT = ir.IntType(16)
_SIZES = {FLOAT: "f32", INT: "i32"}

EXP = (
    1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1,
    1.0, 1.0,
)  # fmt: skip
"""Coefficients of the polynomial of Cephes for exp(r), |r| <= log(2) / 2, highest power first."""


SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
"""Coefficients of the polynomials of Cephes in r^2 for (sin(r) - r) / r^3 and (cos(r) - 1 + r^2 / 2) / r^4,
|r| <= pi / 4, highest power first."""


def vector(element: Any) -> ir.VectorType:
    return ir.VectorType(element, LANES)


class Lanes:
    """A vector of LANES float32, int32 or truth values. Operators take another vector of the same kind, or a
    Python number, which stands for LANES copies of itself. Comparisons give truth values, which &, | and ~
    combine."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.b, self.value = builder, value
        self.element = value.type.element
        self.is_float = isinstance(self.element, ir.FloatType)

    def _new(self, value: Any) -> Lanes:
        return Lanes(self.b, value)

    def _other(self, other: Any) -> Any:
        if isinstance(other, Lanes):
            return other.value
        number = float(np.float32(other)) if self.is_float else int(other)
        return ir.Constant(vector(self.element), [number] * LANES)

    def like(self, number: float) -> Lanes:
        """Return LANES copies of a number, as a vector of the same kind."""
        return self._new(self._other(number))

    def _binary(self, of_floats: str, of_integers: str, other: Any) -> Lanes:
        operation = getattr(self.b, of_floats if self.is_float else of_integers)
        return self._new(operation(self.value, self._other(other)))

    def __add__(self, other: Any) -> Lanes:
        return self._binary("fadd", "add", other)

    def __sub__(self, other: Any) -> Lanes:
        return self._binary("fsub", "sub", other)

    def __mul__(self, other: Any) -> Lanes:
        return self._binary("fmul", "mul", other)

    def __truediv__(self, other: Any) -> Lanes:
        return self._binary("fdiv", "sdiv", other)

    def __and__(self, other: Any) -> Lanes:
        return self._binary("and_", "and_", other)

    def __or__(self, other: Any) -> Lanes:
        return self._binary("or_", "or_", other)

    def __xor__(self, other: Any) -> Lanes:
        return self._binary("xor", "xor", other)

    def __rshift__(self, other: Any) -> Lanes:
        return self._binary("ashr", "ashr", other)

    def __rsub__(self, other: Any) -> Lanes:
        return self.like(other) - self

    def __rtruediv__(self, other: Any) -> Lanes:
        return self.like(other) / self

    def __lshift__(self, other: Any) -> Lanes:
        return self._binary("shl", "shl", other)

    def __invert__(self) -> Lanes:
        return self._new(self.b.not_(self.value))

    def __neg__(self) -> Lanes:
        return self._new(self.b.fneg(self.value) if self.is_float else self.b.neg(self.value))

    def _compare(self, how: str, other: Any) -> Lanes:
        compare = self.b.fcmp_ordered if self.is_float else self.b.icmp_signed
        return self._new(compare(how, self.value, self._other(other)))

    def __lt__(self, other: Any) -> Lanes:
        return self._compare("<", other)

    def __gt__(self, other: Any) -> Lanes:
        return self._compare(">", other)

    def __le__(self, other: Any) -> Lanes:
        return self._compare("<=", other)

    def __ge__(self, other: Any) -> Lanes:
        return self._compare(">=", other)

    def is_not(self, other: Any) -> Lanes:
        return self._compare("!=", other)

    def call(self, name: str, *others: Any) -> Lanes:
        """Call one of LLVM's intrinsic functions on vectors of this kind."""
        kind = vector(self.element)
        values = [self.value, *(self._other(other) for other in others)]
        function = ir.FunctionType(kind, [kind] * len(values))
        full = f"llvm.{name}.v{LANES}{_SIZES[self.element]}"
        return self._new(self.b.call(cgutils.get_or_insert_function(self.b.module, function, full), values))

    def least(self, other: Any) -> Lanes:
        return self.call("minnum" if self.is_float else "smin", other)

    def most(self, other: Any) -> Lanes:
        return self.call("maxnum" if self.is_float else "smax", other)

    def to_float(self) -> Lanes:
        return self._new(self.b.sitofp(self.value, vector(FLOAT)))

    def to_int(self) -> Lanes:
        """Convert to int32, rounded towards zero."""
        return self._new(self.b.fptosi(self.value, vector(INT)))

    def wide(self) -> Lanes:
        """Extend integers to 64 bits, for indices into large grids, which exceed 32 bits."""
        return self._new(self.b.sext(self.value, vector(LONG)))

    def halves(self) -> tuple[Lanes, Lanes]:
        """Return the lower and the upper int32 of integers of 64 bits."""
        upper = self.b.lshr(self.value, self._other(32))
        low, high = (self.b.trunc(value, vector(INT)) for value in (self.value, upper))
        return self._new(low), self._new(high)

    def as_float(self) -> Lanes:
        """Reinterpret the same bits as float32."""
        return self._new(self.b.bitcast(self.value, vector(FLOAT)))

    def exp(self) -> Lanes:
        """Return exp, to a relative error of 2e-7: 0 below the range of float32, infinity above it, NaN for
        NaN."""
        y = choose(self < -104, self.like(-104), self)
        y = choose(y > 89, y.like(89), y)
        power = (y * np.log2(np.e)).call("rint")
        rest = power.call("fma", -0.693359375, y)
        rest = power.call("fma", 2.12194440e-4, rest)
        total = self.like(EXP[0])
        for coefficient in EXP[1:]:
            total = total.call("fma", rest, coefficient)
        exponent = power.to_int()
        half = exponent >> 1  # multiplied in two steps: 2^-150 itself is no float32
        for part in (half, exponent - half):
            total = total * ((part + 127) << 23).as_float()
        return total

    def sin_cos(self) -> tuple[Lanes, Lanes]:
        """Return sin and cos, each to 1.2e-7, of angles of up to a thousand radians."""
        quarters = (self * (2 / np.pi)).call("rint")
        rest = quarters.call("fma", -float(np.float32(np.pi / 2)), self)
        rest = quarters.call("fma", float(np.float32(np.pi / 2)) - np.pi / 2, rest)
        square = rest * rest
        sine, cosine = self.like(SINE[0]), self.like(COSINE[0])
        for of_sine, of_cosine in zip(SINE[1:], COSINE[1:], strict=True):
            sine, cosine = square.call("fma", sine, of_sine), square.call("fma", cosine, of_cosine)
        sine = (sine * square).call("fma", rest, rest)
        cosine = (cosine * square).call("fma", square, square.call("fma", -0.5, square.like(1.0)))
        number = quarters.to_int()
        swap = (number & 1).is_not(0)
        sin, cos = choose(swap, cosine, sine), choose(swap, sine, cosine)
        return (
            choose((number & 2).is_not(0), -sin, sin),
            choose(((number + 1) & 2).is_not(0), -cos, cos),
        )

    def greatest(self) -> Any:
        """Return the greatest of the lanes, one int32."""
        kind = ir.FunctionType(INT, [vector(INT)])
        name = f"llvm.vector.reduce.smax.v{LANES}i32"
        return self.b.call(cgutils.get_or_insert_function(self.b.module, kind, name), [self.value])

    def any(self) -> Any:
        """Return whether any lane is true, as a single truth value."""
        word = self.b.bitcast(self.value, ir.IntType(LANES))
        return self.b.icmp_unsigned("!=", word, ir.Constant(ir.IntType(LANES), 0))


def choose(condition: Lanes, yes: Lanes, no: Any) -> Lanes:
    return Lanes(condition.b, condition.b.select(condition.value, yes.value, yes._other(no)))


def address(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return the address of the first number of `array`, an argument of type `kind`."""
    return context.make_array(kind)(context, builder, array).data


def unpacked(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Unpack a named tuple, an argument of type `kind`. Its arrays become the addresses of their first
    numbers."""
    parts = (builder.extract_value(value, n) for n in range(len(kind.types)))
    return kind.instance_class(
        *(
            address(context, builder, of, part) if isinstance(of, types.Array) else part
            for of, part in zip(kind.types, parts, strict=True)
        )
    )


def splat(builder: Any, scalar: Any) -> Lanes:
    """Return LANES copies of one number."""
    nothing = ir.Constant(vector(scalar.type), ir.Undefined)
    one = builder.insert_element(nothing, scalar, INT(0))
    return Lanes(builder, builder.shuffle_vector(one, nothing, ir.Constant(vector(INT), [0] * LANES)))


def load(builder: Any, base: Any, first: Any, element: Any = FLOAT) -> Lanes:
    """Load LANES numbers from the index `first` on."""
    place = builder.bitcast(builder.gep(base, [first]), ir.PointerType(vector(element)))
    return Lanes(builder, builder.load(place, align=2 if element == SHORT else 4))


def store(base: Any, first: Any, values: Lanes) -> None:
    b = values.b
    place = b.bitcast(b.gep(base, [first]), ir.PointerType(values.value.type))
    b.store(values.value, place, align=4)


def gather(base: Any, index: Lanes, size: int, where: Lanes, kind: Any = INT, offset: int = 0) -> Lanes:
    """Load an integer of a `kind` for each lane that is true in `where`, from `index` times `size` bytes
    behind the address `base`. The other lanes read at index 0, and become 0.

    `index` has 32 bits or, from `wide`, 64; offsets in bytes have 64 bits either way. `offset` is a number
    that is added to the index of all lanes: several gathers around one index share the computation of
    addresses.

    Lanes are loaded one by one: the gather instructions of Intel's processors take a fifth longer here.
    """
    b = where.b
    numbers = choose(where, index, 0).value
    start = b.gep(b.bitcast(base, ir.PointerType(BYTE)), [LONG(offset * size)])
    words: Any = ir.Constant(vector(kind), ir.Undefined)
    for lane in range(LANES):
        number = b.extract_element(numbers, INT(lane))
        at = b.mul(number if index.element == LONG else b.sext(number, LONG), LONG(size))
        place = b.bitcast(b.gep(start, [at]), ir.PointerType(kind))
        words = b.insert_element(words, b.load(place, align=1), INT(lane))
    return choose(where, Lanes(b, words), 0)


def scatter(base: Any, index: Lanes, values: Lanes, where: Lanes) -> None:
    """Store numbers of four bytes, of the lanes that are true in `where`, at the indices `index` from the
    address `base` on."""
    b = where.b
    start = splat(b, b.ptrtoint(base, LONG)).value
    numbers = b.mul(b.sext(index.value, vector(LONG)), ir.Constant(vector(LONG), [4] * LANES))
    places = b.inttoptr(b.add(numbers, start), ir.VectorType(ir.PointerType(values.element), LANES))
    kind = ir.FunctionType(ir.VoidType(), [values.value.type, places.type, INT, where.value.type])
    name = f"llvm.masked.scatter.v{LANES}{_SIZES[values.element]}.v{LANES}p0"
    function = cgutils.get_or_insert_function(b.module, kind, name)
    b.call(function, [values.value, places, INT(4), where.value])


class Variable:
    """A vector whose value can change, for instance in a loop."""

    def __init__(self, first: Lanes) -> None:
        self._b = first.b
        self._place = cgutils.alloca_once(first.b, first.value.type)
        self.set(first)

    def get(self) -> Lanes:
        return Lanes(self._b, self._b.load(self._place))

    def set(self, value: Lanes) -> None:
        self._b.store(value.value, self._place)


@contextmanager
def while_any(builder: Any, active: Variable) -> Iterator[None]:
    """Make the code of the `with` block a loop that goes on as long as any lane of `active` is true."""
    head, body, end = (builder.append_basic_block(name) for name in ("any", "lanes", "none"))
    builder.branch(head)
    builder.position_at_end(head)
    builder.cbranch(active.get().any(), body, end)
    builder.position_at_end(body)
    yield
    builder.branch(head)
    builder.position_at_end(end)
