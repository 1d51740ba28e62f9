// Decodes which bricks a level has and which of their cells are live: an octree, from the coarse to the fine
// (docs/format.md, "What is coded"). The twin of player/asset/structure.py.

import { Bricks, coordOf, keyOf } from "./bricks.js";
import { Decoder, SYMBOL_OF_ZERO } from "./coder.js";

const N_CHILDREN = 8;
const N_CLASSES = 50;
const MUST = 49;
const DEAD = 0;
const LIVE = 1;
const UNKNOWN = 2;
const COUNT = Uint8Array.of(1, 7, 0); // added to a class by a dead, a live and an unknown neighbour

// Decode the bricks of a level.
// - data: the bytes of the level's section;
// - cellsPerAxis: the level's cells along each axis;
// - parent: the bricks of the next coarser level; null for the coarsest;
// - nBricks: how many bricks the level has;
// - where: the section's name in error messages.
// Rejects with an Error if the data break the format, or hold another number of bricks. Memory is bounded by the numbers
// of bricks of the two levels and the length of `data`.
export async function decodeStructure(data, cellsPerAxis, parent, nBricks, where) {
  const nAbove = 32 - Math.clz32(cellsPerAxis - 1);
  const pieces = piecesOf(data, parent ? 2 : nAbove, where);
  let bricks;
  if (parent) {
    const octants = octantsOf(parent);
    const refined = await decodeOctants(pieces[0], octants, where);
    const n = refined.reduce((sum, symbol) => sum + symbol, 0);
    if (n !== nBricks) throw new Error(`${where}: expected ${nBricks} bricks, got ${n}`);
    bricks = await decodeChildren(pieces[1], octants, refined, where);
  } else {
    bricks = new Bricks(Int32Array.of(0), Uint32Array.of(1, ...new Array(15).fill(0)));
    for (const piece of pieces) {
      const octants = octantsOf(bricks);
      if (octants.named.n > nBricks) throw new Error(`${where}: expected ${nBricks} bricks, got more above`);
      bricks = await decodeChildren(piece, octants, new Uint8Array(octants.named.n).fill(1), where);
    }
    if (bricks.n !== nBricks) throw new Error(`${where}: expected ${nBricks} bricks, got ${bricks.n}`);
  }
  checkInside(bricks, cellsPerAxis, where);
  return bricks;
}

// Split `data` into n pieces, each preceded by its length in bytes, uint32.
function piecesOf(data, n, where) {
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const pieces = [];
  let at = 0;
  for (let i = 0; i < n; i++) {
    if (data.length < at + 4) throw new Error(`${where}: expected ${n} blocks, got ${i}`);
    const begin = at + 4;
    at = begin + view.getUint32(at, true);
    pieces.push(data.subarray(begin, at));
  }
  if (at !== data.length) throw new Error(`${where}: expected ${at} bytes, got ${data.length}`);
  return pieces;
}

function checkInside({ keys, masks }, cellsPerAxis, where) {
  const nWhole = cellsPerAxis >> 3; // bricks along an axis that lie entirely inside the grid
  for (let i = 0; i < keys.length; i++) {
    const [x, y, z] = coordOf(keys[i]);
    if (x < nWhole && y < nWhole && z < nWhole) continue;
    const [nx, ny, nz] = [cellsPerAxis - 8 * x, cellsPerAxis - 8 * y, cellsPerAxis - 8 * z];
    for (let b = 0; b < 512; b++) {
      const isLive = (masks[16 * i + (b >> 5)] >>> (b & 31)) & 1;
      if (isLive && (b >> 6 >= nx || ((b >> 3) & 7) >= ny || (b & 7) >= nz)) {
        throw new Error(`${where}: expected cells below ${cellsPerAxis} along each axis, got one behind`);
      }
    }
  }
}

// Find the octants that have live cells. An octant is 4 x 4 x 4 cells of a brick, the place of one brick of the next finer
// level. `named` finds octants by the coordinates of these finer bricks; `live` Uint16Array [4 n] has their cells: bit
// 4 y + z of number x of an octant.
function octantsOf(bricks) {
  const nibbles = (brick, octant, x) => {
    const word = bricks.masks[16 * brick + 2 * (4 * (octant >> 2) + x) + ((octant >> 1) & 1)] >>> (4 * (octant & 1));
    return (word & 15) | ((word >>> 4) & 0xf0) | ((word >>> 8) & 0xf00) | ((word >>> 12) & 0xf000);
  };
  const keys = new Int32Array(8 * bricks.n);
  let n = 0;
  for (let i = 0; i < bricks.n; i++) {
    const key = bricks.keys[i];
    for (let octant = 0; octant < 8; octant++) {
      if (nibbles(i, octant, 0) | nibbles(i, octant, 1) | nibbles(i, octant, 2) | nibbles(i, octant, 3)) {
        keys[n++] = 2 * key + keyOf(octant >> 2, (octant >> 1) & 1, octant & 1);
      }
    }
  }
  const named = new Bricks(keys.slice(0, n).sort(), new Uint32Array(0));
  const live = new Uint16Array(4 * n);
  for (let i = 0; i < n; i++) {
    const [x, y, z] = [named.keys[i] >> 18, (named.keys[i] >> 9) & 511, named.keys[i] & 511];
    const brick = bricks.find(x >> 1, y >> 1, z >> 1);
    for (let along = 0; along < 4; along++) live[4 * i + along] = nibbles(brick, 4 * (x & 1) + 2 * (y & 1) + (z & 1), along);
  }
  return { named, live };
}

// Return the number of the octant beside each octant, along an axis (0 is x) on a side (-1 or 1): Int32Array [n], n where
// there is none.
function octantsBeside(named, axis, side) {
  const found = new Int32Array(named.n);
  const step = [0, 0, 0];
  step[axis] = side;
  for (let i = 0; i < named.n; i++) {
    const key = named.keys[i];
    const other = named.find((key >> 18) + step[0], ((key >> 9) & 511) + step[1], (key & 511) + step[2]);
    found[i] = other < 0 ? named.n : other;
  }
  return found;
}

async function decodeOctants(data, octants, where) {
  const { named } = octants;
  const neighbours = [2, 1, 0].map((axis) => octantsBeside(named, axis, -1));
  const decoder = await Decoder.open(data, neighbours, 1, 1, where);
  const found = new Uint8Array(named.n).fill(SYMBOL_OF_ZERO);
  decoder.channel(new Uint8Array(named.n), found);
  decoder.finish();
  return asBits(found, `${where}: bricks`);
}

// Turn symbols + 63 into symbols, in place. Throws an Error unless all of them are 0 or 1.
function asBits(found, where) {
  for (let i = 0; i < found.length; i++) {
    found[i] -= SYMBOL_OF_ZERO;
    if (found[i] > 1) throw new Error(`${where}: expected 0 or 1, got others`);
  }
  return found;
}

// Find the parents, which are the live cells of refined octants. `local` Uint8Array [n]: 16 x + 4 y + z of each in its
// octant; `octant` Int32Array [n]: the octant's number; `beside` [axis][before or after] Int32Array [n]: the row of the cell
// beside each parent, n for a cell that is not live, n + 1 for a live one in an octant that is not refined.
function parentsOf(octants, refined) {
  const { named } = octants;
  const { rows, n } = rowsOfCells(octants, refined);
  const octant = new Int32Array(n);
  const local = new Uint8Array(n);
  placesOfRows(rows, octant, local);
  const beside = [16, 4, 1].map((stride, axis) => [-1, 1].map((side) => (
    rowsBeside(rows, octant, local, octantsBeside(named, axis, side), stride, side))));
  return { octant, local, beside, n };
}

// Number the parents: { rows, n }. `rows` has the row of each cell of each octant, -1 for a cell that is not live, and -2
// for a live cell in an octant that is not refined. The cells of one more octant, which stands for missing ones, are all
// -1. `n` is the number of rows.
function rowsOfCells({ named, live }, refined) {
  const rows = new Int32Array(64 * (named.n + 1)).fill(-1, 64 * named.n);
  let n = 0;
  for (let i = 0; i < named.n; i++) {
    for (let local = 0; local < 64; local++) {
      const isLive = (live[4 * i + (local >> 4)] >> (local & 15)) & 1;
      rows[64 * i + local] = !isLive ? -1 : refined[i] ? n++ : -2;
    }
  }
  return { rows, n };
}

function placesOfRows(rows, octant, local) {
  for (let at = 0; at < rows.length; at++) {
    const row = rows[at];
    if (row < 0) continue;
    octant[row] = at >> 6;
    local[row] = at & 63;
  }
}

// Return the rows of the cells beside the parents, on a side along an axis. `others`: the octants beside the octants there;
// `stride`: how much `local` changes from cell to cell along the axis.
function rowsBeside(rows, octant, local, others, stride, side) {
  const n = octant.length;
  const found = new Int32Array(n);
  const edge = side < 0 ? 0 : 3 * stride;
  for (let i = 0; i < n; i++) {
    const isInside = (local[i] & (3 * stride)) !== edge;
    const place = isInside ? 64 * octant[i] + local[i] + side * stride
      : 64 * others[octant[i]] + local[i] - 3 * side * stride;
    const other = rows[place];
    found[i] = other >= 0 ? other : other === -1 ? n : n + 1;
  }
  return found;
}

async function decodeChildren(data, octants, refined, where) {
  const parents = parentsOf(octants, refined);
  const { n, beside } = parents;
  const neighbours = [2, 1, 0].map((axis) => beside[axis][0].map((row) => Math.min(row, n)));
  const decoder = await Decoder.open(data, neighbours, N_CHILDREN, N_CLASSES, where);
  const known = Array.from({ length: N_CHILDREN }, () => {
    const states = new Uint8Array(n + 2).fill(UNKNOWN);
    states[n] = DEAD;
    states[n + 1] = LIVE;
    return states;
  });
  const classes = new Uint8Array(n);
  const hasLive = new Uint8Array(n);
  for (let child = 0; child < N_CHILDREN; child++) {
    const [x, y, z] = [4, 2, 1].map((bit, axis) => ({ own: known[child ^ bit], beside: beside[axis][child & bit ? 1 : 0] }));
    setClasses(classes, x.own, x.beside, y.own, y.beside, z.own, z.beside);
    if (child === N_CHILDREN - 1) setMust(classes, hasLive);
    const found = known[child].subarray(0, n);
    decoder.channel(classes, found);
    addBits(hasLive, asBits(found, `${where}: cells`));
  }
  decoder.finish();
  if (hasLive.includes(0)) throw new Error(`${where}: cells: expected a live child of each live cell`);
  return childBricks(octants, refined, parents, known);
}

function setClasses(classes, ownX, besideX, ownY, besideY, ownZ, besideZ) {
  for (let i = 0; i < classes.length; i++) {
    classes[i] = COUNT[ownX[i]] + COUNT[ownX[besideX[i]]] + COUNT[ownY[i]] + COUNT[ownY[besideY[i]]] + COUNT[ownZ[i]] + COUNT[ownZ[besideZ[i]]];
  }
}

function setMust(classes, hasLive) {
  for (let i = 0; i < classes.length; i++) if (!hasLive[i]) classes[i] = MUST;
}

function addBits(bits, more) {
  for (let i = 0; i < bits.length; i++) bits[i] |= more[i];
}

// Return the bricks of the finer level, one for each refined octant.
function childBricks(octants, refined, parents, known) {
  const keys = octants.named.keys.filter((_, i) => refined[i]);
  const masks = new Uint32Array(16 * keys.length);
  let brick = -1;
  for (let i = 0; i < parents.n; i++) {
    if (i === 0 || parents.octant[i] !== parents.octant[i - 1]) brick++;
    const local = parents.local[i];
    const lowest = ((local >> 4) << 7) | (((local >> 2) & 3) << 4) | ((local & 3) << 1);
    for (let child = 0; child < N_CHILDREN; child++) {
      const b = lowest + ((child >> 2) << 6) + (((child >> 1) & 1) << 3) + (child & 1);
      masks[16 * brick + (b >> 5)] |= known[child][i] << (b & 31);
    }
  }
  return new Bricks(keys, masks);
}
