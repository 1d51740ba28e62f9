// Arranges a scene for the march on a GPU: flat arrays that become textures. The twin of player/asset/grid.py.
//
// - table [nb^3] Int32: for a place in a brick of the finest level, at (bx * nb + by) * nb + bz: slot << 3 | level of the
//   finest brick there, or minus the distance in bricks to the nearest place that has one with a live cell there;
// - density [slots * 162 * 2] Uint32: a texel of two words for each half column of each brick with its apron, at
//   slot * 162 + (x * 9 + y) * 2 + half, x, y = 0..8. The first word has the codes z = 0..3 of the half, the second that
//   of z = 4, and in bits 8 to 11 whether the cells z = 0..3 are live: a cell is read with four fetches;
// - owners [nf^3] Int32: number << 3 | level of the brick that holds the feature vertices around a place, or -1;
// - columns [held * 81 * 2] Uint32: a texel for each column of these bricks with their apron, at number * 81 + x * 9 + y:
//   the row of its first stored vertex, and which are stored: bits 0 to 8, and above them how many rows behind the first
//   the vertex z = 8 is, which is in the next brick;
// - features [rows * words * 4] the codes of each row, four channels a word.
import { coordOf, popcount } from "./bricks.js";

const MOST_DISTANCE = 31;
const HALF_COLUMNS = 162; // of a brick with an apron
const COLUMNS = 81;

const bricksAlong = (cells) => Math.ceil(cells / 8);

// How many words a row of features takes: 1, 2 or an even number, so that a texel of four words begins at one or
// in its middle.
export function featureWords(nChannels) {
  const words = Math.ceil(nChannels / 4);
  return words < 3 ? words : words + (words & 1);
}

// Nothing anywhere: what is shown before a scene is.
export const NO_GRID = {
  resolution: 1, nb: 1, nSlots: 0, table: Int32Array.of(-1), density: new Uint32Array(0),
  featureResolution: 1, nf: 1, nHeld: 0, nRows: 0, owners: Int32Array.of(-1), columns: new Uint32Array(0), features: new Uint32Array(0),
};

// What the densities `{ levels, vertices, values, firstRows }` of parts.js become: { resolution, nb, nSlots, table, density }.
export function arrangeDensities({ resolution, level_steps: levelSteps }, densities) {
  const shown = shownBricks(densities.levels, resolution), nb = bricksAlong(resolution);
  return {
    resolution, nb, nSlots: shown.count,
    table: tableOf(shown.levels, nb, levelSteps),
    density: densityTexels(densities, shown.levels, shown.count),
  };
}

// What the features become: { featureResolution, nf, nHeld, nRows, owners, columns, features }.
export function arrangeFeatures({ feature_resolution: featureResolution }, features) {
  const held = heldBricks(features, featureResolution);
  return {
    featureResolution, nf: held.n, nHeld: held.count, nRows: features.values.length / features.n_channels,
    owners: held.owners, columns: columnTexels(held), features: featureTexels(features, featureWords(features.n_channels)),
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

// A place in a coarse brick none of whose cells there is live is as empty as one without a brick, unless a sample that
// begins there may stand for several steps.
function tableOf(shown, n, levelSteps) {
  const table = new Int32Array(n ** 3).fill(-1);
  for (const { level, first, bricks, numbers } of [...shown].reverse()) {
    numbers.forEach((number, i) => {
      const entry = ((first + i) << 3) | level, own = bricks.masks.subarray(16 * number, 16 * number + 16);
      const whole = level === 0 || levelSteps[level] > 1;
      eachPlace(n, level, coordOf(bricks.keys[number]), (place, x, y, z) => {
        table[place] = whole || someLive(own, level, x, y, z) ? entry : -1;
      });
    });
  }
  addDistances(table, n);
  return table;
}

// Whether a cell of a coarse brick is live at a place of the finest level: 4 x 4 x 4 cells, 2 x 2 x 2, or one.
function someLive(cells, level, ...place) {
  const count = Math.max(8 >> level, 1);
  const [x, y, z] = place.map((c) => ((8 * c) >> level) & 7);
  for (let i = x; i < x + count; i++) {
    for (let j = y; j < y + count; j++) {
      const line = cells[2 * i + (j >> 2)] >>> (8 * (j & 3) + z);
      if (line & ((1 << count) - 1)) return true;
    }
  }
  return false;
}

// Distances in the largest coordinate, in two sweeps over a padded grid, from the neighbours before and behind.
function addDistances(table, n) {
  const m = n + 2, distances = new Uint8Array(m ** 3).fill(MOST_DISTANCE);
  const padded = (x, y, z) => ((x + 1) * m + y + 1) * m + z + 1;
  for (let x = 0, at = 0; x < n; x++) {
    for (let y = 0; y < n; y++) {
      for (let z = 0; z < n; z++, at++) if (table[at] >= 0) distances[padded(x, y, z)] = 0;
    }
  }
  const before = [];
  for (let o = 0; o < 13; o++) before.push((Math.floor(o / 9) - 1) * m * m + ((Math.floor(o / 3) % 3) - 1) * m + (o % 3) - 1);
  const sweep = (at, sign) => {
    let least = distances[at];
    for (let o = 0; o < 13 && least > 0; o++) least = Math.min(least, distances[at + sign * before[o]] + 1);
    distances[at] = least;
  };
  for (let x = 0; x < n; x++) {
    for (let y = 0; y < n; y++) for (let z = 0; z < n; z++) sweep(padded(x, y, z), 1);
  }
  for (let x = n - 1; x >= 0; x--) {
    for (let y = n - 1; y >= 0; y--) for (let z = n - 1; z >= 0; z--) sweep(padded(x, y, z), -1);
  }
  for (let x = 0, at = 0; x < n; x++) {
    for (let y = 0; y < n; y++) {
      for (let z = 0; z < n; z++, at++) if (table[at] < 0) table[at] = -distances[padded(x, y, z)];
    }
  }
}

function densityTexels({ vertices, values, firstRows }, shown, count) {
  const texels = new Uint32Array(2 * HALF_COLUMNS * count);
  const column = new Uint8Array(9);
  for (const { level, first, bricks, numbers } of shown) {
    const read = new ColumnReader(vertices[level], firstRows[level]);
    for (let i = 0; i < numbers.length; i++) {
      read.moveTo(...coordOf(bricks.keys[numbers[i]]));
      const cells = bricks.masks.subarray(16 * numbers[i], 16 * numbers[i] + 16);
      let at = 2 * HALF_COLUMNS * (first + i);
      for (let x = 0; x < 9; x++) {
        for (let y = 0; y < 9; y++, at += 4) {
          read.column(x, y);
          let row = read.row, mask = read.mask;
          for (let z = 0; z < 8; z++, mask >>= 1) column[z] = mask & 1 ? values[row++] : 0;
          column[8] = mask & 1 ? values[read.row8] : 0;
          const live = x < 8 && y < 8 ? cells[2 * x + (y >> 2)] >>> (8 * (y & 3)) : 0;
          texels[at] = column[0] | (column[1] << 8) | (column[2] << 16) | (column[3] << 24);
          texels[at + 1] = column[4] | ((live & 15) << 8);
          texels[at + 2] = column[4] | (column[5] << 8) | (column[6] << 16) | (column[7] << 24);
          texels[at + 3] = column[8] | (((live >> 4) & 15) << 8);
        }
      }
    }
  }
  return texels;
}

// Reads the columns along z of one brick with its apron: `mask` has a bit for each stored vertex z = 0..8, `row` is
// the row of the first of z = 0..7, `row8` that of z = 8.
class ColumnReader {
  constructor({ bricks, ranks }, firstRow) {
    Object.assign(this, { vertices: bricks, firstRows: ranks.first, firstRow, bricks: new Int32Array(8), mask: 0, row: 0, row8: 0 });
  }

  moveTo(x, y, z) {
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
  const owners = new Int32Array(n ** 3).fill(-1); // -2 - number << 3 | level: a corner is stored, but no brick
  const shown = shownBricks(levels, resolution).levels;
  const held = [];
  let count = 0;
  for (let level = levels.length - 1; level >= 0; level--) {
    const { bricks, numbers } = shown[level];
    const hold = (coords, code) => {
      for (const coord of coords) {
        const entry = code((count++ << 3) | level);
        eachPlace(n, level, coord, (place) => (owners[place] = entry));
      }
      held.push({ vertices: vertices[level], coords, firstRow: firstRows[level] });
    };
    hold(Array.from(numbers, (number) => coordOf(bricks.keys[number])), (entry) => entry);
    const isFree = (x, y, z) => owners[((x << level) * n + (y << level)) * n + (z << level)] < 0;
    hold(withCorners(vertices[level].bricks, bricksAlong(Math.ceil(resolution / 2 ** level)), isFree), (entry) => -2 - entry);
  }
  for (let i = 0; i < owners.length; i++) if (owners[i] < -1) owners[i] = -2 - owners[i];
  return { n, owners, held, count };
}

// Coordinates, sorted, of the bricks in which a cell has a stored corner, there or in the next brick, where `wanted`.
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
  marked.forEach((mark, i) => mark && found.push([Math.floor(i / (n * n)), Math.floor(i / n) % n, i % n]));
  return found;
}

function columnTexels({ held, count }) {
  const texels = new Uint32Array(2 * COLUMNS * count);
  let at = 0;
  for (const { vertices, coords, firstRow } of held) {
    const read = new ColumnReader(vertices, firstRow);
    for (const coord of coords) {
      read.moveTo(...coord);
      for (let x = 0; x < 9; x++) {
        for (let y = 0; y < 9; y++, at += 2) {
          read.column(x, y);
          const first = read.mask & 255 ? read.row : read.row8;
          texels[at] = read.mask ? first : 0;
          texels[at + 1] = read.mask | (read.mask & 256 ? (read.row8 - first) << 9 : 0);
        }
      }
    }
  }
  return texels;
}

// The codes as words; without a copy where rows are whole words that `words` counts.
function featureTexels({ values, n_channels: nChannels }, words) {
  if (nChannels === 4 * words && values.byteOffset % 4 === 0) {
    return new Uint32Array(values.buffer, values.byteOffset, values.length / 4);
  }
  const nRows = values.length / nChannels, padded = new Int8Array(4 * words * nRows);
  for (let row = 0; row < nRows; row++) {
    padded.set(values.subarray(row * nChannels, (row + 1) * nChannels), 4 * words * row);
  }
  return new Uint32Array(padded.buffer);
}
