// Arranges a scene for the march on a GPU: flat arrays that become textures. The twin of player/asset/grid.py.
//
// - table [nb^3 * 4] Uint8: for a place in a brick of the finest level, at (bx * nb + by) * nb + bz: where the densities of
//   the finest brick there are, (x, y, z) in bricks, and MANY + its level; or the level of a coarser brick whose cells there
//   are all dead, if its samples stand for several steps, else 0, then 0, 0 and the distance in bricks to the nearest place
//   that has a brick, for coarser ones one with a live cell there;
// - density [Uint8]: a block of bricks (`blockOf`) of 8 x 8 x 10 texels of four bytes. The texel (x, y, z) of a brick, z = 0..8,
//   has the codes of the vertices (x, y), (x, y + 1), (x + 1, y) and (x + 1, y + 1), so that a cell is read with two fetches;
//   that of z = 9 has in its first byte which cells of the column are live, a bit for each;
// - owners [nf^3 * 4] Uint8: of the brick that holds the feature vertices around a place where its columns are, (x, y, z) in
//   bricks, and its level; NO_LEVEL where there is none;
// - columns [Uint32]: a block of bricks of 9 x 8 x 1 texels of four numbers. The texel (x, y) of a brick has two numbers for
//   the vertices (x, y, 0..7), and two for (x, y + 1, 0..7): bit z of a number tells whether that vertex is stored, and its
//   bits from 8 on the row of the first that is; the second number is that of the next brick along z, for the vertex z = 8;
// - features [Int8]: rows of codes, four a texel, ROWS_A_LINE a line, as parts.js has them.
import { coordOf, keyOf, popcount } from "./bricks.js";

const MOST_DISTANCE = 31;
export const MANY = 32;
export const NO_LEVEL = 255;
export const DENSITY_BRICK = [8, 8, 10]; // texels
export const COLUMN_BRICK = [9, 8, 1];
export const LINES_A_LAYER = 256;

const AROUND = 9 ** 3; // vertices of a brick with its apron

const bricksAlong = (cells) => Math.ceil(cells / 8);

// Texels that a row of features takes, and how many rows lie beside each other: a power of two, no more than 2048 texels.
export const featureWords = (nChannels) => Math.ceil(nChannels / 4);
export const rowsALine = (nChannels) => 2 ** Math.floor(Math.log2(2048 / featureWords(nChannels)));

// How bricks of a texture lie side by side: { across, layers, size: [3] texels }, number n at (n % across, n / across % across,
// n / across^2). At most 25 layers, so that few places are left over, and no side is longer than it has to be.
export function blockOf(n, brick) {
  const across = Math.max(Math.ceil(Math.sqrt(n / 25)), 1), layers = Math.max(Math.ceil(n / across ** 2), 1);
  if (across > 256) throw new Error(`memory of the GPU: expected at most ${25 * 256 ** 2} bricks, got ${n}`);
  return { across, layers, size: [across * brick[0], across * brick[1], layers * brick[2]] };
}

const placeOf = (n, { across }) => [n % across, Math.floor(n / across) % across, Math.floor(n / across ** 2)];

// Nothing anywhere: what is shown before a scene is.
export const NO_GRID = {
  resolution: 1, nb: 1, nSlots: 0, table: Uint8Array.of(0, 0, 0, 1), density: new Uint8Array(2560),
  featureResolution: 1, nf: 1, nHeld: 0, nRows: 0, owners: Uint8Array.of(0, 0, 0, NO_LEVEL), columns: new Uint32Array(288),
  features: new Int8Array(0),
};

// What the densities `{ levels, vertices, values, firstRows }` of parts.js become: { resolution, nb, nSlots, table, density }.
export function arrangeDensities({ resolution, level_steps: levelSteps }, densities) {
  const shown = shownBricks(densities.levels, resolution), nb = bricksAlong(resolution);
  return {
    resolution, nb, nSlots: shown.count,
    table: tableOf(shown, nb, levelSteps),
    density: densityTexels(densities, shown),
  };
}

// What the features become: { featureResolution, nf, nHeld, nRows, owners, columns, features }.
export function arrangeFeatures({ feature_resolution: featureResolution }, features) {
  const { n, owners, held, count } = heldBricks(features, featureResolution);
  return {
    featureResolution, nf: n, nHeld: count, nRows: features.values.length / features.stride,
    owners: ownerTexels(owners, count),
    columns: columnTexels(held, count),
    features: features.values,
  };
}

// The bricks of each level that finer ones do not hide wholly, [{ level, first, bricks, numbers }], in `bricks` of the level
// those with the `numbers`; `count` of all levels.
function shownBricks(levels, resolution) {
  const found = [];
  let first = 0;
  levels.forEach((bricks, level) => {
    let numbers = Uint32Array.from({ length: bricks.n }, (_, i) => i);
    if (level) {
      const finer = levels[level - 1], nFiner = bricksAlong(Math.ceil(resolution / 2 ** (level - 1)));
      const hidden = new Uint8Array(bricks.n);
      for (let i = 0; i < finer.n; i++) {
        const [x, y, z] = coordOf(finer.keys[i]), owner = bricks.find(x >> 1, y >> 1, z >> 1);
        if (owner >= 0) hidden[owner]++;
      }
      const halves = (c) => (2 * c + 1 < nFiner ? 2 : 1);
      numbers = numbers.filter((i) => hidden[i] < coordOf(bricks.keys[i]).reduce((product, c) => product * halves(c), 1));
    }
    found.push({ level, first, bricks, numbers });
    first += numbers.length;
  });
  return { levels: found, count: first };
}

// Calls paint(place, i, j, k) for all places of the finest level in the brick at (x, y, z) of a level.
function eachPlace(n, level, [x, y, z], paint) {
  const end = (c) => Math.min((c + 1) << level, n);
  for (let i = x << level; i < end(x); i++) {
    for (let j = y << level; j < end(y); j++) {
      for (let k = z << level; k < end(z); k++) paint((i * n + j) * n + k, i, j, k);
    }
  }
}

// A place in a coarse brick none of whose cells there is live is as empty as one without a brick, but that a sample that
// begins there may stand for several steps.
function tableOf({ levels, count }, n, levelSteps) {
  const block = blockOf(count, DENSITY_BRICK);
  const table = new Uint32Array(n ** 3); // four bytes each, the first the lowest
  for (const { level, first, bricks, numbers } of [...levels].reverse()) {
    numbers.forEach((number, i) => {
      const [x, y, z] = placeOf(first + i, block), entry = x | (y << 8) | (z << 16) | ((MANY + level) << 24);
      const own = bricks.masks.subarray(16 * number, 16 * number + 16);
      const dead = levelSteps[level] > 1 ? level : 0;
      eachPlace(n, level, coordOf(bricks.keys[number]), (place, i, j, k) => {
        table[place] = level === 0 || someLive(own, level, i, j, k) ? entry : dead;
      });
    });
  }
  addDistances(table, n);
  return new Uint8Array(table.buffer);
}

// Whether a cell of a coarse brick is live at a place of the finest level: 4 x 4 x 4 cells, 2 x 2 x 2, or one.
function someLive(cells, level, i, j, k) {
  const count = Math.max(8 >> level, 1);
  const x = ((8 * i) >> level) & 7, y = ((8 * j) >> level) & 7, z = ((8 * k) >> level) & 7;
  for (let cx = x; cx < x + count; cx++) {
    for (let cy = y; cy < y + count; cy++) {
      const line = cells[2 * cx + (cy >> 2)] >>> (8 * (cy & 3) + z);
      if (line & ((1 << count) - 1)) return true;
    }
  }
  return false;
}

// Distances in the largest coordinate, in two sweeps over a padded grid, from the neighbours before and behind: four lines of
// these beside a line of places, and the place before each.
function addDistances(table, n) {
  const isBrick = (entry) => entry >= 2 ** 24;
  const m = n + 2, distances = new Uint8Array(m ** 3).fill(MOST_DISTANCE), least = new Uint8Array(m);
  const padded = (x, y) => ((x + 1) * m + y + 1) * m + 1; // where the line of z = 0... begins
  for (let x = 0, at = 0; x < n; x++) {
    for (let y = 0; y < n; y++) {
      for (let to = padded(x, y), end = to + n; to < end; at++, to++) if (isBrick(table[at])) distances[to] = 0;
    }
  }
  // `sign`: 1 where the lines before are looked at, -1 for those behind; the z before a place then is z - sign.
  const sweepLine = (first, sign) => {
    const a = first - sign * (m * m + m) - 1, b = a + sign * m, c = b + sign * m, d = first - sign * m - 1;
    for (let i = 0; i < m; i++) least[i] = Math.min(distances[a + i], distances[b + i], distances[c + i], distances[d + i]);
    let z = sign > 0 ? 0 : n - 1, before = distances[first + z - sign];
    for (let left = n; left > 0; left--, z += sign) {
      before = Math.min(distances[first + z], Math.min(before, least[z], least[z + 1], least[z + 2]) + 1);
      distances[first + z] = before;
    }
  };
  for (let x = 0; x < n; x++) for (let y = 0; y < n; y++) sweepLine(padded(x, y), 1);
  for (let x = n - 1; x >= 0; x--) for (let y = n - 1; y >= 0; y--) sweepLine(padded(x, y), -1);
  for (let x = 0, at = 0; x < n; x++) {
    for (let y = 0; y < n; y++) {
      for (let from = padded(x, y), end = from + n; from < end; at++, from++) if (!isBrick(table[at])) table[at] |= distances[from] << 24;
    }
  }
}

// Where the texels of a brick begin.
function firstTexel(n, block, [nx, ny, nz]) {
  const [x, y, z] = placeOf(n, block), [width, height] = block.size;
  return (nz * z * height + ny * y) * width + nx * x;
}

function densityTexels({ vertices, values, firstRows }, { levels, count }) {
  const block = blockOf(count, DENSITY_BRICK), [width, height, depth] = block.size;
  const texels = new Uint32Array(width * height * depth), codes = new Uint8Array(AROUND);
  for (const { level, first, bricks: { keys, masks }, numbers } of levels) {
    const read = new ColumnReader(vertices[level], firstRows[level]);
    for (let i = 0; i < numbers.length; i++) {
      read.moveTo(keys[numbers[i]]);
      gatherCodes(read, values, codes);
      const begin = firstTexel(first + i, block, DENSITY_BRICK);
      putCodes(codes, texels, begin, width, height);
      putLive(masks, 16 * numbers[i], texels, begin + 9 * width * height, width);
    }
  }
  return new Uint8Array(texels.buffer);
}

// The codes of a brick with its apron, 0 where a vertex is not stored.
function gatherCodes(read, values, codes) {
  for (let x = 0; x < 9; x++) {
    for (let y = 0; y < 9; y++) {
      read.column(x, y);
      let at = 9 * y + x, row = read.row, mask = read.mask;
      for (let z = 0; z < 8; z++, mask >>= 1, at += 81) codes[at] = mask & 1 ? values[row++] : 0;
      codes[at] = mask & 1 ? values[read.row8] : 0;
    }
  }
}

function putCodes(codes, texels, begin, width, height) {
  for (let z = 0, from = 0; z < 9; z++, from += 9) {
    for (let y = 0; y < 8; y++) {
      let to = begin + (z * height + y) * width;
      let pair = codes[from] | (codes[from + 9] << 8);
      from++;
      for (let end = to + 8; to < end; to++, from++) {
        const next = codes[from] | (codes[from + 9] << 8);
        texels[to] = pair | (next << 16);
        pair = next;
      }
    }
  }
}

function putLive(masks, word, texels, begin, width) {
  for (let y = 0, to = begin; y < 8; y++, to += width) {
    for (let x = 0; x < 8; x++) texels[to + x] = (masks[word + 2 * x + (y >> 2)] >>> (8 * (y & 3))) & 255;
  }
}

// Reads the columns along z of one brick with its apron: `mask` has a bit for each stored vertex z = 0..8, `row` is
// the row of the first of z = 0..7, `row8` that of z = 8.
class ColumnReader {
  constructor({ bricks, ranks }, firstRow) {
    Object.assign(this, { vertices: bricks, firstRows: ranks.first, firstRow, bricks: new Int32Array(8), mask: 0, row: 0, row8: 0 });
  }

  moveTo(key) {
    const x = key >> 18, y = (key >> 9) & 511, z = key & 511;
    for (let o = 0; o < 8; o++) this.bricks[o] = this.vertices.find(x + (o >> 2), y + ((o >> 1) & 1), z + (o & 1));
  }

  column(x, y) {
    const { firstRows, vertices: { masks } } = this;
    const corner = ((x >> 3) << 2) | ((y >> 3) << 1);
    const word = 2 * (x & 7) + ((y & 7) >> 2), shift = 8 * (y & 3);
    const brick = this.bricks[corner], next = this.bricks[corner | 1];
    this.mask = 0;
    if (brick >= 0) {
      const bits = masks[16 * brick + word];
      this.mask = (bits >>> shift) & 255;
      this.row = this.firstRow + firstRows[16 * brick + word] + popcount(bits & ((1 << shift) - 1));
    }
    if (next >= 0) {
      const bits = masks[16 * next + word];
      this.mask |= ((bits >>> shift) & 1) << 8;
      this.row8 = this.firstRow + firstRows[16 * next + word] + popcount(bits & ((1 << shift) - 1));
    }
  }
}

// Which bricks hold the features' vertices, as `vertex_rows` in player/asset/grid.py says.
function heldBricks({ levels, vertices, firstRows }, resolution) {
  const n = bricksAlong(resolution);
  const owners = new Int32Array(n ** 3).fill(-1); // number << 3 | level, or -2 minus that: a corner is stored, but no brick
  const shown = shownBricks(levels, resolution).levels;
  const held = [];
  let count = 0;
  for (let level = levels.length - 1; level >= 0; level--) {
    const { bricks, numbers } = shown[level];
    const hold = (keys, code) => {
      for (const key of keys) {
        const entry = code((count++ << 3) | level);
        eachPlace(n, level, coordOf(key), (place) => (owners[place] = entry));
      }
      held.push({ vertices: vertices[level], keys, firstRow: firstRows[level] });
    };
    hold(Array.from(numbers, (number) => bricks.keys[number]), (entry) => entry);
    const isFree = (x, y, z) => owners[((x << level) * n + (y << level)) * n + (z << level)] < 0;
    hold(withCorners(vertices[level].bricks, bricksAlong(Math.ceil(resolution / 2 ** level)), isFree), (entry) => -2 - entry);
  }
  for (let i = 0; i < owners.length; i++) if (owners[i] < -1) owners[i] = -2 - owners[i];
  return { n, owners, held, count };
}

// Keys, sorted, of the bricks in which a cell has a stored corner, there or in the next brick, where `wanted`.
function withCorners({ keys, masks }, n, wanted) {
  const marked = new Uint8Array(n ** 3), found = [];
  keys.forEach((key, i) => {
    const coord = coordOf(key);
    for (let o = 0; o < 8; o++) {
      const [x, y, z] = [coord[0] - (o >> 2), coord[1] - ((o >> 1) & 1), coord[2] - (o & 1)];
      if (x < 0 || y < 0 || z < 0 || x >= n || y >= n || z >= n) continue;
      let some = 0;
      for (let w = 0; w < (o & 4 ? 2 : 16); w++) {
        some |= o & 2 ? (w & 1 ? 0 : masks[16 * i + w] & 255) & (o & 1 ? 1 : 255) : masks[16 * i + w] & (o & 1 ? 0x01010101 : -1);
      }
      if (some && wanted(x, y, z)) marked[(x * n + y) * n + z] = 1;
    }
  });
  marked.forEach((mark, i) => mark && found.push(keyOf(Math.floor(i / (n * n)), Math.floor(i / n) % n, i % n)));
  return found;
}

function columnTexels(held, count) {
  const block = blockOf(count, COLUMN_BRICK), [width, height, depth] = block.size;
  const texels = new Uint32Array(4 * width * height * depth);
  let number = 0;
  for (const { vertices, keys, firstRow } of held) {
    const read = new ColumnReader(vertices, firstRow);
    for (const key of keys) {
      read.moveTo(key);
      putColumns(read, texels, firstTexel(number++, block, COLUMN_BRICK), width);
    }
  }
  return texels;
}

function putColumns(read, texels, begin, width) {
  const put = (x, y, half, own, next) => {
    const to = 4 * (begin + y * width + x) + half;
    texels[to] = own;
    texels[to + 1] = next;
  };
  for (let x = 0; x < 9; x++) {
    for (let y = 0; y < 9; y++) {
      read.column(x, y);
      const { mask, row, row8 } = read, own = mask & 255 ? (row << 8) | (mask & 255) : 0, next = mask >> 8 ? (row8 << 8) | 1 : 0;
      if (y < 8) put(x, y, 0, own, next);
      if (y > 0) put(x, y - 1, 2, own, next);
    }
  }
}

function ownerTexels(owners, count) {
  const block = blockOf(count, COLUMN_BRICK), texels = new Uint32Array(owners.length); // four bytes each, the first the lowest
  for (let i = 0; i < owners.length; i++) {
    const [x, y, z] = placeOf(owners[i] >> 3, block);
    texels[i] = owners[i] < 0 ? NO_LEVEL << 24 : x | (y << 8) | (z << 16) | ((owners[i] & 7) << 24);
  }
  return new Uint8Array(texels.buffer);
}
