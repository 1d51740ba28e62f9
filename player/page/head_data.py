"""A head in the form that a page reads: `head.json`, which describes its layers, and `head.bin`, their
numbers.

A layer in the JSON is {"n_in", "n_out", "weight", "bias", "scale"}. The last three are null or {"type":
"float32", "int8" or "int32", "first": the index of the first byte in `head.bin`, a multiple of 4}. The names
of layers are those of `player.head.graph.HeadArrays`. `monomials` are pairs [parent, axis]: each monomial is
the product of an earlier one (-1 for 1) and a component of the direction.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np

from player.head.graph import HeadArrays, Layer, Rounding, monomial_products

_TYPES = {"float32": "<f4", "int8": "<i1", "int32": "<i4"}


class HeadData(NamedTuple):
    """The two files of a head."""

    description: bytes
    """`head.json`."""
    numbers: bytes
    """`head.bin`."""


class _Numbers:
    def __init__(self) -> None:
        self.data = b""

    def add(self, array: np.ndarray | None) -> dict[str, Any] | None:
        if array is None:
            return None
        first = len(self.data)
        data = np.ascontiguousarray(array, _TYPES[array.dtype.name]).tobytes()
        self.data += data + bytes(-len(data) % 4)
        return {"type": array.dtype.name, "first": first}

    def layer(self, layer: Layer) -> dict[str, Any]:
        n_in, n_out = layer.weight.shape
        names = {name: self.add(getattr(layer, name)) for name in Layer._fields}
        return {"n_in": n_in, "n_out": n_out, **names}


def head_data(head: HeadArrays) -> HeadData:
    """Make the files of a head."""
    numbers = _Numbers()
    description = {
        "sh_degree": head.form.sh_degree,
        "in_8_bits": head.form.in_8_bits,
        "activation": head.form.activation,
        "n_channels": head.n_channels,
        "spatial": [numbers.layer(layer) for layer in head.spatial],
        "to_sh": numbers.layer(head.to_sh),
        "harmonics": numbers.layer(head.harmonics),
        "bottleneck": numbers.layer(head.bottleneck),
        "from_sh": numbers.layer(head.from_sh),
        "directional": [numbers.layer(layer) for layer in head.directional],
        "output": numbers.layer(head.output),
        "roundings": [_rounding(each) for each in head.roundings],
        "of_encoded": None if head.of_encoded is None else _rounding(head.of_encoded),
        "monomials": monomial_products(head.form.sh_degree),
    }
    return HeadData(json.dumps(description, separators=(",", ":")).encode(), numbers.data)


def _rounding(rounding: Rounding) -> dict[str, float | int]:
    return {"scale": float(rounding.scale), "zero": int(rounding.zero)}
