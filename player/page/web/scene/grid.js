// Arranges a scene for the march on a GPU: flat arrays that become textures. The twin of player/asset/grid.py. A *place* is
// the space of one brick of the finest level.
//
// - table [nb^3 * 4] Uint8: for the place of brick (bx, by, bz), at (bx * nb + by) * nb + bz: where the densities of the finest
//   brick there are, (x, y, z) in bricks, and MANY + its level. A coarser brick whose cells in the place are all dead counts as
//   none. Without a brick: the level of such a dead brick, if samples of that level stand for several steps, else 0; then 0, 0
//   and the distance in bricks to the nearest place that has a brick;
// - density [Uint8]: a block of bricks (`blockOf`) of 8 x 8 x 10 texels of four bytes. The texel (x, y, z) of a brick, z = 0..8,
//   has the codes of the vertices (x, y), (x, y + 1), (x + 1, y) and (x + 1, y + 1), so that a cell is read with two fetches.
//   The first byte of the texel with z = 9 tells which cells of the column are live, a bit for each;
// - owners [nf^3 * 4] Uint8: for each place of the features, where the columns of the brick that holds the vertices around the
//   place are, (x, y, z) in bricks, and that brick's level; NO_LEVEL where no brick holds any;
// - columns [Uint32]: a block of bricks of 9 x 8 x 1 texels of four numbers. The texel (x, y) of a brick has two numbers for
//   the vertices (x, y, 0..7), and two for (x, y + 1, 0..7). In the first of two, bit z tells whether that vertex is stored, and
//   the bits from 8 on are the row of the first that is. The second is the same for the vertex z = 8, in the next brick along z;
// - features [Int8]: rows of codes as in parts.js, four codes a texel, `rowsALine` rows a line.
import { coordOf, keyOf, popcount } from "./bricks.js";

const MOST_DISTANCE = 31;
export const MANY = 32;
export const NO_LEVEL = 255;
export const DENSITY_BRICK = [8, 8, 10]; // texels
export const COLUMN_BRICK = [9, 8, 1];
export const LINES_A_LAYER = 256;

const MOST_BRICKS = 25 * 256 ** 2;
const AROUND = 9 ** 3; // vertices of a brick with its apron

const bricksAlong = (cells) => Math.ceil(cells / 8);

// Return how many texels a row of features takes, and how many rows a line of the texture has: the largest power of two with
// at most 2048 texels.
export const featureWords = (nChannels) => Math.ceil(nChannels / 4);
export const rowsALine = (nChannels) => 2 ** Math.floor(Math.log2(2048 / featureWords(nChannels)));

// Arrange n bricks in a texture: { across, layers, size: [3] texels }. Brick i is at (i % across, i / across % across,
// i / across^2), in bricks. `across` is the least with which the block is not higher than wide, or has at most 25 layers: no
// side is long, because there are devices that have no 3D textures of more than 256 texels a side, and few places are left
// over. There are at most 256 layers, whose numbers are stored in a byte.
export function blockOf(n, brick) {
  if (n > MOST_BRICKS) throw new Error(`memory of the GPU: expected at most ${MOST_BRICKS} bricks, got ${n}`);
  const layersOf = (across) => Math.max(Math.ceil(n / across ** 2), 1);
  let across = Math.max(Math.ceil(Math.sqrt(n / 256)), 1);
  while (layersOf(across) > 25 && across * brick[0] < layersOf(across) * brick[2]) across++;
  const layers = layersOf(across);
  return { across, layers, size: [across * brick[0], across * brick[1], layers * brick[2]] };
}

const placeOf = (n, { across }) => [n % across, Math.floor(n / across) % across, Math.floor(n / across ** 2)];

// An empty grid, which is shown before that of the scene is there.
export const NO_GRID = {
  resolution: 1, nb: 1, nSlots: 0, table: Uint8Array.of(0, 0, 0, 1), density: new Uint8Array(2560),
  featureResolution: 1, nf: 1, nHeld: 0, nRows: 0, owners: Uint8Array.of(0, 0, 0, NO_LEVEL), columns: new Uint32Array(288),
  features: new Int8Array(0),
};

// Arrange the densities `{ levels, vertices, values, firstRows }` of parts.js: { resolution, nb, nSlots, table, density }.
export function arrangeDensities({ resolution, level_steps: levelSteps }, densities) {
  const shown = shownBricks(densities.levels, resolution), nb = bricksAlong(resolution);
  return {
    resolution, nb, nSlots: shown.count,
    table: tableOf(shown, nb, levelSteps),
    density: densityTexels(densities, shown),
  };
}

// Arrange the features of parts.js: { featureResolution, nf, nHeld, nRows, owners, columns, features }.
export function arrangeFeatures({ feature_resolution: featureResolution }, features) {
  const { n, owners, held, count } = heldBricks(features, featureResolution);
  return {
    featureResolution, nf: n, nHeld: count, nRows: features.values.length / features.stride,
    owners: ownerTexels(owners, count),
    columns: columnTexels(held, count),
    features: features.values,
  };
}

// Find the bricks of each level that finer ones do not hide completely: { levels: [{ level, first, bricks, numbers }], count }.
// `numbers` are the indices of these bricks among all `bricks` of the level, `first` is how many there are in finer levels, and
// `count` how many in all levels.
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

// Call paint(place, i, j, k) for all places of the finest level in the brick at (x, y, z) of a level.
function eachPlace(n, level, [x, y, z], paint) {
  const end = (c) => Math.min((c + 1) << level, n);
  for (let i = x << level; i < end(x); i++) {
    for (let j = y << level; j < end(y); j++) {
      for (let k = z << level; k < end(z); k++) paint((i * n + j) * n + k, i, j, k);
    }
  }
}

// Make the table. A place where all cells of a coarse brick are dead is treated as one without a brick, except that a sample
// that begins there may stand for several steps.
function tableOf({ levels, count }, n, levelSteps) {
  const block = blockOf(count, DENSITY_BRICK);
  const table = new Uint32Array(n ** 3); // four bytes each, the lowest first
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

// Return whether any cell of a coarse brick is live in a place of the finest level, which covers 4 x 4 x 4 of its cells,
// 2 x 2 x 2, or one.
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

// Add the distances (the largest difference of any coordinate) to the places without a brick. There are two sweeps over a
// padded grid, from the neighbours before each place and from those behind: places in four neighbouring lines, three in each,
// and the place before in the same line.
function addDistances(table, n) {
  const isBrick = (entry) => entry >= 2 ** 24;
  const m = n + 2, distances = new Uint8Array(m ** 3).fill(MOST_DISTANCE), least = new Uint8Array(m);
  const padded = (x, y) => ((x + 1) * m + y + 1) * m + 1; // where the line of places from z = 0 on begins
  for (let x = 0, at = 0; x < n; x++) {
    for (let y = 0; y < n; y++) {
      for (let to = padded(x, y), end = to + n; to < end; at++, to++) if (isBrick(table[at])) distances[to] = 0;
    }
  }
  // `sign`: 1 to look at the lines before, -1 for those behind. The place before in the same line is at z - sign.
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

// Return the index of the first texel of brick n in a block.
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

// Read the codes of a brick with its apron into `codes`, at 81 z + 9 y + x; 0 where a vertex is not stored.
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

// A reader of the columns along z of one brick with its apron. `mask` has a bit for each stored vertex z = 0..8, `row` is
// the row of the first stored one of z = 0..7, `row8` that of z = 8.
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

// Find the bricks that hold the features' vertices around each place, as `vertex_rows` in player/asset/grid.py does.
function heldBricks({ levels, vertices, firstRows }, resolution) {
  const n = bricksAlong(resolution);
  const owners = new Int32Array(n ** 3).fill(-1); // number << 3 | level; -2 minus that: no brick, but a stored corner
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

// Return the sorted keys of the bricks that have a cell with a stored corner, be it in the same or in the next brick, and for
// which `wanted` is true. `n`: bricks of the level along an axis.
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
  const block = blockOf(count, COLUMN_BRICK), texels = new Uint32Array(owners.length); // four bytes each, the lowest first
  for (let i = 0; i < owners.length; i++) {
    const [x, y, z] = placeOf(owners[i] >> 3, block);
    texels[i] = owners[i] < 0 ? NO_LEVEL << 24 : x | (y << 8) | (z << 16) | ((owners[i] & 7) << 24);
  }
  return new Uint8Array(texels.buffer);
}
