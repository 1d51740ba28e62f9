"""Pictures in one file on a disk, mapped into memory, in an order that suits random draws.

A step of training wants some hundred pixels from anywhere in all pictures. If pictures lay in the file as
they are, each of these pixels would need its own page of the disk. So every picture's pixels are written in
another order, in which neighbours come from far apart. In that order each picture is cut into as many pieces
as there are *chunks*. A chunk of the file holds one piece of every picture: an even sample of all of them,
read at once.

The pixel at place p of a picture of n pixels is number (stride p) mod n. The stride is about n times the
golden ratio and has no common factor with n: any run of places is then spread evenly over the picture, and
the order of a picture takes no memory. Pictures have three channels in the file if all are opaque, else four.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, NamedTuple, overload

import numpy as np

PIXELS_OF_A_PIECE = 8192
"""Approximate number of pixels in a piece. A disk reads and writes scattered pieces of this size, some 24 kB,
about as fast as one whole file."""
GOLDEN = (math.sqrt(5) - 1) / 2
STRIDES_TRIED = 100
_PLACES_AT_ONCE = 1 << 20


class StoreLayout(NamedTuple):
    """The positions of the pictures' pixels in the file, counted in pixels."""

    sizes: np.ndarray
    """[n_pictures, 2] int64: width and height."""
    edges: np.ndarray
    """[n_pictures, n_chunks + 1] int64: the places at which each picture is cut into pieces."""
    begins: np.ndarray
    """[n_pictures, n_chunks] int64: the position in the file at which each piece begins."""
    chunks: np.ndarray
    """[n_chunks + 1] int64: the position in the file at which each chunk begins, and the end of the last."""

    @classmethod
    def of(cls, sizes: Iterable[tuple[int, int]]) -> StoreLayout:
        """Return the layout of pictures of `sizes` (width, height), at least one.

        >>> StoreLayout.of([(160, 120), (160, 120), (2, 1)]).chunks.tolist()
        [0, 19201, 38402]
        """
        table = np.array(list(sizes), np.int64)
        n_pixels = table.prod(axis=1)
        n_chunks = max(1, int(np.median(n_pixels)) // PIXELS_OF_A_PIECE)
        edges = np.arange(n_chunks + 1) * n_pixels[:, None] // n_chunks
        pieces = np.diff(edges, axis=1)
        chunks = np.concatenate([[0], np.cumsum(pieces.sum(axis=0))])
        begins = chunks[:-1] + np.cumsum(pieces, axis=0) - pieces
        return cls(table, edges, begins, chunks)


@lru_cache(maxsize=4096)
def stride_of(n_pixels: int) -> int:
    """Return the stride of the order of a picture of `n_pixels`: of the numbers around n_pixels times the
    golden ratio that have no factor in common with it, the one whose runs are spread best.

    >>> stride_of(1), stride_of(100), math.gcd(stride_of(1_920_000), 1_920_000)
    (1, 73, 1)
    """
    middle = int(n_pixels * GOLDEN)
    around = range(max(1, middle - STRIDES_TRIED), min(middle + STRIDES_TRIED, max(n_pixels, 2)))
    fitting = [stride for stride in around if math.gcd(stride, n_pixels) == 1]
    return min(fitting, key=lambda stride: (_largest_quotient(n_pixels, stride), abs(stride - middle)))


def _largest_quotient(a: int, b: int) -> int:
    """Return the largest partial quotient of the continued fraction of b / a. The larger it is, the wider are
    the gaps between the first multiples of b modulo a (Khinchin, Continued fractions; the golden ratio has
    ones alone)."""
    largest = 0
    while b:
        largest = max(largest, a // b)
        a, b = b, a % b
    return largest


def in_order(image: np.ndarray, n_channels: int) -> np.ndarray:
    """Return the pixels [height * width, n_channels] of a picture [height, width, 4] uint8, place after
    place."""
    # Pixels are moved as four bytes at a time: ten times as fast as rows of a few bytes.
    whole = np.ascontiguousarray(image).view(np.uint32).reshape(-1)
    pixels = whole.take(_order(len(whole))).view(np.uint8).reshape(-1, 4)
    return np.ascontiguousarray(pixels[:, :n_channels])


def write_picture(file: BinaryIO, layout: StoreLayout, number: int, pixels: np.ndarray) -> None:
    """Write a picture's pixels, ordered by `in_order`, to their positions in the file. Raises OSError."""
    n_channels, edges = pixels.shape[1], layout.edges[number]
    for chunk, begin in enumerate(layout.begins[number].tolist()):
        file.seek(begin * n_channels)
        file.write(pixels[edges[chunk] : edges[chunk + 1]].data)


@lru_cache(maxsize=2)
def _order(n_pixels: int) -> np.ndarray:
    """Return the number of the pixel at each place, [n_pixels] int32."""
    stride, order = stride_of(n_pixels), np.empty(n_pixels, np.int32)
    for begin in range(0, n_pixels, _PLACES_AT_ONCE):
        places = np.arange(begin, min(begin + _PLACES_AT_ONCE, n_pixels))
        order[begin : begin + _PLACES_AT_ONCE] = places * stride % n_pixels
    return order


class StoredImages(Sequence[np.ndarray]):
    """Some or all of the pictures of a file that `write_picture` has filled. Each, [height, width, 4] uint8,
    is read when it is asked for.

    Their pixels are also divided into *chunks*. A chunk holds a share of the pixels of every picture, spread
    over the whole picture, and lies in one place on the disk. A caller that draws pixels at random draws them
    from one chunk after the other.
    """

    def __init__(
        self,
        file: np.ndarray,
        layout: StoreLayout,
        transparent: frozenset[int],
        numbers: Sequence[int] | None = None,
    ) -> None:
        """Make a sequence of pictures of a file.

        `file`: [n_pixels, 3 or 4] uint8, mapped. `transparent`: the numbers of the file's pictures that are
        not opaque. `numbers`: the file's pictures that the sequence has, in this order; None for all.
        """
        self._file, self._layout, self._transparent = file, layout, transparent
        self._numbers = list(range(len(layout.sizes)) if numbers is None else numbers)
        self.n_chunks = len(layout.chunks) - 1

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> StoredImages: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | StoredImages:
        if isinstance(index, slice):
            return self.some(range(len(self))[index])
        number = self._numbers[index]
        width, height = self._layout.sizes[number].tolist()
        edges = self._layout.edges[number].tolist()
        places = np.full((height * width, 4), 255, np.uint8)
        for chunk, begin in enumerate(self._layout.begins[number].tolist()):
            piece = self._file[begin : begin + edges[chunk + 1] - edges[chunk]]
            places[edges[chunk] : edges[chunk + 1], : piece.shape[1]] = piece
        image = np.empty(height * width, np.uint32)
        image[_order(height * width)] = places.view(np.uint32)[:, 0]
        return image.view(np.uint8).reshape(height, width, 4)

    def some(self, numbers: Sequence[int]) -> StoredImages:
        """Return the pictures with these numbers."""
        return StoredImages(self._file, self._layout, self._transparent, [self._numbers[i] for i in numbers])

    def size(self, number: int) -> tuple[int, int]:
        """Return the width and height of a picture without reading it."""
        width, height = self._layout.sizes[self._numbers[number]].tolist()
        return width, height

    def opaque(self, number: int) -> bool:
        """Return whether all of a picture is opaque, without reading it."""
        return self._numbers[number] not in self._transparent

    def pixels(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """Read only the given `pixels` [n] of a picture, numbered in row-major order. Returns [n, 4]
        uint8."""
        which = self._numbers[number]
        n_pixels = int(self._layout.sizes[which].prod())
        places = np.asarray(pixels, np.int64) * pow(stride_of(n_pixels), -1, n_pixels) % n_pixels
        edges = self._layout.edges[which]
        chunk = np.searchsorted(edges, places, side="right") - 1
        rgba = np.full((len(places), 4), 255, np.uint8)
        rows = self._file[self._layout.begins[which][chunk] + places - edges[chunk]]
        rgba[:, : rows.shape[1]] = rows
        return rgba

    def chunk(self, number: int) -> np.ndarray:
        """Read the pixels of a chunk, [n, 3 or 4] uint8, picture after picture."""
        begins, edges = self._layout.begins[:, number], self._layout.edges
        pieces = [
            self._file[begins[i] : begins[i] + edges[i, number + 1] - edges[i, number]] for i in self._numbers
        ]
        # Prefetch: the system reads the next chunk while pixels are drawn from this one.
        self._expect((number + 1) % self.n_chunks)
        return np.concatenate(pieces)

    def chunk_places(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the first place of each picture's pixels in a chunk, and the place behind the last,
        [n_pictures] int64 each. The pixel at place p of a picture of n pixels is number (`stride` p) modulo n
        in row-major order."""
        edges = self._layout.edges[self._numbers]
        return edges[:, number], edges[:, number + 1]

    @property
    def strides(self) -> np.ndarray:
        """The stride of each picture, [n_pictures] int64: see `chunk_places`."""
        return np.array([stride_of(int(n)) for n in self._layout.sizes[self._numbers].prod(axis=1)])

    def _expect(self, chunk: int) -> None:
        mapped = getattr(self._file, "_mmap", None)
        if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_WILLNEED"):
            n_channels = self._file.shape[1]
            begin, end = (int(edge) * n_channels for edge in self._layout.chunks[chunk : chunk + 2])
            begin -= begin % mmap.PAGESIZE
            mapped.madvise(mmap.MADV_WILLNEED, begin, end - begin)


def map_pictures(
    path: Path, layout: StoreLayout, n_channels: int, transparent: frozenset[int]
) -> StoredImages:
    """Map the pictures of a file into memory; none of them is read yet. Raises OSError, ValueError (the file
    is too short)."""
    file = np.memmap(path, np.uint8, "r", shape=(int(layout.chunks[-1]), n_channels))
    return StoredImages(file, layout, transparent)
