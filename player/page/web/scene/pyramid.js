// A pyramid: the vertices of its levels, and how their values are computed from symbols (docs/format.md, "Pyramids"). The
// twin of player/asset/pyramid.py and player/asset/symbols.py.

import { Bricks, coordOf, keyOf, NO_BRICKS, popcount, Ranks } from "./bricks.js";

// The bricks of each level, the finest first, and their vertices.
export class Pyramid {
  constructor(resolution, nLevels) {
    this.resolution = resolution;
    this.levels = new Array(nLevels).fill(NO_BRICKS);
    this.vertices = this.levels.map(() => new Vertices(NO_BRICKS, new Uint32Array(0)));
  }

  cellsPerAxis(level) {
    return Math.ceil(this.resolution / 2 ** level);
  }

  setLevel(level, bricks) {
    this.levels[level] = bricks;
    this.vertices[level] = this.verticesOf(level);
  }

  verticesOf(level) {
    const bricks = this.levels[level];
    const corners = cornersOf(bricks);
    const border = new Uint32Array(corners.masks.length);
    if (level + 1 < this.levels.length) {
      const last = Math.ceil(this.cellsPerAxis(level) / 8);
      const beside = neighbourhood(bricks, -1, 1, last).filter((key) => bricks.find(...coordOf(key)) < 0);
      const shown = new Bricks(beside, new Uint32Array(16 * beside.length));
      beside.forEach((key, i) => this.putShown(level + 1, key, shown.bytes, 64 * i));
      const coarser = cornersOf(shown.withoutEmpty());
      for (let i = 0; i < corners.n; i++) {
        const other = coarser.find(...coordOf(corners.keys[i]));
        if (other < 0) continue;
        for (let word = 0; word < 16; word++) {
          border[16 * i + word] = corners.masks[16 * i + word] & coarser.masks[16 * other + word];
        }
      }
    }
    return new Vertices(corners, border);
  }

  // Find which cells of a missing brick are read from live cells of `level` or coarser levels. `key` is the coordinate that
  // the brick would have in the next finer level than `level`. A byte for each line of cells along z goes into `out`, from
  // `at` on.
  putShown(level, key, out, at) {
    let [x, y, z] = coordOf(key);
    let shift = 0; // how many levels coarser the brick that is found is
    let brick = -1;
    const [firstX, firstY, firstZ] = [8 * x, 8 * y, 8 * z];
    for (; brick < 0; level++, shift++) {
      if (level === this.levels.length) return;
      [x, y, z] = [x >> 1, y >> 1, z >> 1];
      brick = this.levels[level].find(x, y, z);
    }
    const { bytes } = this.levels[level - 1];
    const bits = (1 << (8 >> shift || 1)) - 1; // for the cells of a line along z that become the 8 of the missing brick
    for (let line = 0; line < 64; line++) {
      const cellX = ((firstX + (line >> 3)) >> shift) & 7;
      const cellY = ((firstY + (line & 7)) >> shift) & 7;
      let found = (bytes[64 * brick + 8 * cellX + cellY] >> ((firstZ >> shift) & 7)) & bits;
      for (let halves = bits; halves < 255; halves = DOUBLED[halves]) found = DOUBLED[found];
      out[at + line] = found;
    }
  }
}

// For each number of four bits: the number of eight bits in which each bit stands twice.
const DOUBLED = Uint8Array.from({ length: 16 }, (_, bits) => [3, 12, 48, 192].reduce((all, pair, i) => all | (bits & (1 << i) ? pair : 0), 0));

// Return the sorted keys of all coordinates that differ from a brick's by `low` to `high` in each component, and whose
// components are from 0 to `end` - 1.
function neighbourhood(bricks, low, high, end) {
  const offsets = [];
  for (let x = low; x <= high; x++) {
    for (let y = low; y <= high; y++) for (let z = low; z <= high; z++) offsets.push([x, y, z]);
  }
  const keys = new Int32Array(offsets.length * bricks.n);
  let n = 0;
  for (let i = 0; i < bricks.n; i++) {
    const [x, y, z] = coordOf(bricks.keys[i]);
    for (const [dx, dy, dz] of offsets) {
      const inside = Math.min(x + dx, y + dy, z + dz) >= 0 && Math.max(x + dx, y + dy, z + dz) < end;
      if (inside) keys[n++] = keyOf(x + dx, y + dy, z + dz);
    }
  }
  const sorted = keys.subarray(0, n).sort();
  return sorted.filter((key, i) => i === 0 || key !== sorted[i - 1]);
}

// Return the corners of live cells, as bricks of vertices.
function cornersOf(cells) {
  const keys = neighbourhood(cells, 0, 1, 512);
  const masks = new Uint32Array(16 * keys.length);
  const { bytes } = cells;
  const found = new Uint8Array(masks.buffer);
  const around = new Uint16Array(81); // lines of cells, x, y and z from -1 to 7: bit z + 1 at 9 (x + 1) + y + 1
  for (let i = 0; i < keys.length; i++) {
    const [x, y, z] = coordOf(keys[i]);
    around.fill(0);
    for (let before = 0; before < 8; before++) {
      const [dx, dy, dz] = [before >> 2, (before >> 1) & 1, before & 1];
      const brick = cells.find(x - dx, y - dy, z - dz);
      if (brick < 0) continue;
      for (let px = dx ? 7 : 0; px < 8; px++) {
        for (let py = dy ? 7 : 0; py < 8; py++) {
          const line = bytes[64 * brick + 8 * px + py];
          around[9 * (dx ? 0 : px + 1) + (dy ? 0 : py + 1)] |= dz ? line >> 7 : line << 1;
        }
      }
    }
    for (let px = 0; px < 8; px++) {
      for (let py = 0; py < 8; py++) {
        const at = 9 * px + py;
        const line = around[at] | around[at + 1] | around[at + 9] | around[at + 10];
        found[64 * i + 8 * px + py] = line | (line >> 1);
      }
    }
  }
  return new Bricks(keys, masks).withoutEmpty();
}

// The vertices of a level, in the order of their rows. `bricks`: bricks of vertices; `border` Uint32Array [16 n]: the masks
// of those vertices that are on the border.
export class Vertices {
  constructor(bricks, border) {
    this.bricks = bricks;
    this.border = border;
    this.ranks = new Ranks(bricks, bricks.masks);
    this.n = this.ranks.n;
    this.nStored = this.n - border.reduce((sum, word) => sum + popcount(word), 0); // vertices that have symbols
  }

  // Return the neighbours and classes of the vertices that are not on the border, which are needed to decode their symbols.
  // `neighbours` [alongZ, alongY, alongX] Int32Array [n]: rows, n where there is none; `classes` Uint8Array [n]: how many
  // coordinates are odd.
  rows() {
    const { bricks, border } = this;
    const stored = new Ranks(bricks, bricks.masks.map((word, i) => word & ~border[i]));
    const neighbours = [0, 1, 2].map(() => new Int32Array(stored.n));
    const classes = new Uint8Array(stored.n);
    const [alongZ, alongY, alongX] = neighbours;
    const own = new Int32Array(512);
    const { n } = stored;
    let row = 0;
    for (let i = 0; i < bricks.n; i++) {
      const [x, y, z] = coordOf(bricks.keys[i]);
      const beforeZ = bricks.find(x, y, z - 1);
      const beforeY = bricks.find(x, y - 1, z);
      const beforeX = bricks.find(x - 1, y, z);
      own.fill(n);
      for (let word = 0; word < 16; word++) {
        for (let left = stored.masks[16 * i + word]; left !== 0; left &= left - 1) {
          const b = 32 * word + 31 - Math.clz32(left & -left);
          own[b] = row;
          alongZ[row] = b & 7 ? own[b - 1] : stored.at(beforeZ, b + 7, n);
          alongY[row] = b & 56 ? own[b - 8] : stored.at(beforeY, b + 56, n);
          alongX[row] = b & 448 ? own[b - 64] : stored.at(beforeX, b + 448, n);
          classes[row++] = (b & 1) + ((b >> 3) & 1) + ((b >> 6) & 1);
        }
      }
    }
    return { neighbours, classes, n: stored.n };
  }
}

// For each bit b of a brick, the vertices from which the vertex there is predicted: indices into the 5 x 5 x 5 vertices of
// the next coarser level around the brick, at floor and ceil of half its position. These are 1, 2, 4 or 8 different ones,
// repeated until there are 8.
const AROUND = new Uint8Array(512 * 8);
for (let b = 0; b < 512; b++) {
  const [x, y, z] = [b >> 6, (b >> 3) & 7, b & 7];
  const places = new Set();
  for (let k = 0; k < 8; k++) {
    places.add(25 * ((x + (k >> 2)) >> 1) + 5 * ((y + ((k >> 1) & 1)) >> 1) + ((z + (k & 1)) >> 1));
  }
  const different = [...places];
  for (let k = 0; k < 8; k++) AROUND[8 * b + k] = different[k % different.length];
}

// Compute the values of some channels of a level, `clip(predicted + step * symbol)`, into `values`.
// - here, coarser: the vertices of the level, and of the next coarser one (null for the coarsest);
// - values, coarserValues: typed arrays, rows of `stride`;
// - first, n: the first channel, and the number of channels;
// - symbols: Uint8Array [n * nStored], channel by channel, symbols + 63;
// - beyond: for each of these channels, as far as it has symbols of -63 or 63, { bytes, first }: how much further from 0
//   these symbols are, from number `first` of `bytes` on;
// - step: the level's step; low, high: the least and the greatest value.
export function putValues({ here, coarser, values, coarserValues, stride, first, n, symbols, beyond, step, low, high }) {
  const { bricks: { keys, masks }, border, nStored } = here;
  const beyondAt = Int32Array.from(beyond, (channel) => channel.first);
  const near = new Int16Array(125 * n);
  const predicted = new Int16Array(n);
  let symbolRow = 0;
  let into = first;
  for (let i = 0; i < keys.length; i++) {
    if (coarser) gather(coarser, keys[i], coarserValues, stride, first, n, near);
    for (let word = 0; word < 16; word++) {
      const notStored = border[16 * i + word];
      for (let left = masks[16 * i + word] | 0; left !== 0; left &= left - 1, into += stride) {
        const bit = left & -left;
        if (coarser) predict(near, 32 * word + 31 - Math.clz32(bit), n, predicted);
        if (notStored & bit) {
          for (let k = 0; k < n; k++) values[into + k] = predicted[k];
          continue;
        }
        for (let k = 0, at = symbolRow; k < n; k++, at += nStored) {
          let symbol = symbols[at] - 63;
          if (symbol === 0) {
            values[into + k] = predicted[k];
            continue;
          }
          if (symbol === 63) symbol += beyond[k].bytes[beyondAt[k]++];
          else if (symbol === -63) symbol -= beyond[k].bytes[beyondAt[k]++];
          const value = predicted[k] + step * symbol;
          values[into + k] = value < low ? low : value > high ? high : value;
        }
        symbolRow++;
      }
    }
  }
}

// For each octant, 0 to 7, of a brick, and each of the 5 x 5 x 5 vertices around the octant: the vertex's bit in its brick,
// plus 512 times the number of that brick, 0 to 7, among the octant's brick and its neighbours along +x, +y and +z.
const PLACES = Uint16Array.from({ length: 8 * 125 }, (_, i) => {
  const [octant, place] = [Math.floor(i / 125), i % 125];
  const x = 4 * (octant >> 2) + Math.floor(place / 25);
  const y = 4 * ((octant >> 1) & 1) + (Math.floor(place / 5) % 5);
  const z = 4 * (octant & 1) + (place % 5);
  return (4 * (x >> 3) + 2 * (y >> 3) + (z >> 3)) * 512 + (((x & 7) << 6) | ((y & 7) << 3) | (z & 7));
});
const found = new Int32Array(8);

// Copy the coarser level's values at the 5 x 5 x 5 vertices around a brick of vertices into `near` [125 n].
function gather(coarser, key, values, stride, first, n, near) {
  const [x, y, z] = coordOf(key);
  for (let k = 0; k < 8; k++) {
    found[k] = coarser.bricks.find((x >> 1) + (k >> 2), (y >> 1) + ((k >> 1) & 1), (z >> 1) + (k & 1));
  }
  const octant = 125 * (4 * (x & 1) + 2 * (y & 1) + (z & 1));
  for (let place = 0; place < 125; place++) {
    const at = PLACES[octant + place];
    const from = coarser.ranks.at(found[at >> 9], at & 511, -1);
    if (from < 0) continue; // absent: no vertex of the brick is predicted from it
    for (let k = 0; k < n; k++) near[place * n + k] = values[from * stride + first + k];
  }
}

// Predict the values of the vertex at bit b, [n]: the rounded mean of the vertices around it in `near`.
function predict(near, b, n, predicted) {
  const at = 8 * b;
  const nOdd = (b & 1) + ((b >> 3) & 1) + ((b >> 6) & 1);
  const p0 = AROUND[at] * n;
  const p1 = AROUND[at + 1] * n;
  const p2 = AROUND[at + 2] * n;
  const p3 = AROUND[at + 3] * n;
  if (nOdd === 0) {
    for (let k = 0; k < n; k++) predicted[k] = near[p0 + k];
  } else if (nOdd === 1) {
    for (let k = 0; k < n; k++) predicted[k] = (near[p0 + k] + near[p1 + k] + 1) >> 1;
  } else if (nOdd === 2) {
    for (let k = 0; k < n; k++) predicted[k] = (near[p0 + k] + near[p1 + k] + near[p2 + k] + near[p3 + k] + 2) >> 2;
  } else {
    const p4 = AROUND[at + 4] * n;
    const p5 = AROUND[at + 5] * n;
    const p6 = AROUND[at + 6] * n;
    const p7 = AROUND[at + 7] * n;
    for (let k = 0; k < n; k++) {
      predicted[k] = (near[p0 + k] + near[p1 + k] + near[p2 + k] + near[p3 + k] +
        near[p4 + k] + near[p5 + k] + near[p6 + k] + near[p7 + k] + 4) >> 3;
    }
  }
}
