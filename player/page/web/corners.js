// Which vertices the levels of a pyramid have: the corners of their live cells, brick by brick, in the order of the
// rows that hold their values. The twin of `corners_of` in player/asset/pyramid.py.
//
// A brick is 8 x 8 x 8 cells or vertices; bit x * 64 + y * 8 + z of its mask is in word b >> 5 of its 16 words.

// An index over all bricks of a grid of n x n x n: the number of the brick at each place, -1 where there is none.
export class BrickIndex {
  constructor(n, coords) {
    this.n = n;
    this.numbers = new Int32Array(n * n * n).fill(-1);
    for (let i = 0; i < coords.length / 3; i++) this.numbers[this.place(coords, 3 * i)] = i;
  }

  place(coords, at) {
    return (coords[at] * this.n + coords[at + 1]) * this.n + coords[at + 2];
  }

  at(x, y, z) {
    const { n } = this;
    return x < 0 || y < 0 || z < 0 || x >= n || y >= n || z >= n ? -1 : this.numbers[(x * n + y) * n + z];
  }
}

// The bricks of vertices of a level: { n, coords, masks, firstRows, index }, where firstRows [16 n] is the row, among
// those of the level, of the first vertex of each word.
export function cornersOf(level, bricksPerAxis) {
  const n = bricksPerAxis + 1;
  const near = neighbourhood(level.coords, n);
  const cells = new BrickIndex(n, level.coords);
  const around = new BrickIndex(n, near);
  const count = near.length / 3;
  const masks = new Uint32Array(16 * count);
  for (let i = 0; i < count; i++) {
    const own = cells.numbers[cells.place(near, 3 * i)];
    if (own >= 0) masks.set(level.cells.subarray(16 * own, 16 * own + 16), 16 * i);
  }
  addCorners(masks, near, around);
  return stored(masks, near, n);
}

// Coordinates, sorted, at all offsets of 0 or 1 from some.
function neighbourhood(coords, n) {
  const marked = new Uint8Array(n * n * n);
  for (let i = 0; i < coords.length; i += 3) {
    for (let o = 0; o < 8; o++) {
      marked[((coords[i] + (o >> 2)) * n + coords[i + 1] + ((o >> 1) & 1)) * n + coords[i + 2] + (o & 1)] = 1;
    }
  }
  let count = 0;
  for (let i = 0; i < marked.length; i++) count += marked[i];
  const found = new Uint16Array(3 * count);
  for (let i = 0, at = 0; i < marked.length; i++) {
    if (!marked[i]) continue;
    found[at++] = Math.floor(i / (n * n));
    found[at++] = Math.floor(i / n) % n;
    found[at++] = i % n;
  }
  return found;
}

// Each cell's corners, axis by axis: along z, then y, then x, the last into the next brick. Bricks are taken from the
// last to the first, so that those behind still are what they were.
function addCorners(masks, coords, around) {
  const behind = (i, x, y, z) => around.at(coords[3 * i] - x, coords[3 * i + 1] - y, coords[3 * i + 2] - z);
  const count = coords.length / 3;
  for (let i = count - 1; i >= 0; i--) {
    const before = behind(i, 0, 0, 1);
    for (let w = 0; w < 16; w++) {
      const m = masks[16 * i + w];
      const last = before < 0 ? 0 : (masks[16 * before + w] >>> 7) & 0x01010101;
      masks[16 * i + w] = m | ((m & 0x7f7f7f7f) << 1) | last;
    }
  }
  for (let i = count - 1; i >= 0; i--) {
    const before = behind(i, 0, 1, 0);
    for (let w = 16 * i; w < 16 * i + 16; w += 2) {
      const [low, high] = [masks[w], masks[w + 1]];
      const last = before < 0 ? 0 : masks[w - 16 * i + 16 * before + 1] >>> 24;
      masks[w + 1] = high | (high << 8) | (low >>> 24);
      masks[w] = low | (low << 8) | last;
    }
  }
  for (let i = count - 1; i >= 0; i--) {
    const before = behind(i, 1, 0, 0);
    for (let w = 15; w > 1; w--) masks[16 * i + w] |= masks[16 * i + w - 2];
    if (before < 0) continue;
    for (let w = 0; w < 2; w++) masks[16 * i + w] |= masks[16 * before + 14 + w];
  }
}

function stored(masks, coords, n) {
  let count = 0;
  const found = { n: 0, coords: new Uint16Array(coords.length), masks, firstRows: new Uint32Array(masks.length) };
  let row = 0;
  for (let i = 0; i < coords.length / 3; i++) {
    const first = row;
    for (let w = 0; w < 16; w++) {
      const word = masks[16 * i + w];
      masks[16 * count + w] = word;
      found.firstRows[16 * count + w] = row;
      row += bitCount(word);
    }
    if (row === first) continue;
    for (let axis = 0; axis < 3; axis++) found.coords[3 * count + axis] = coords[3 * i + axis];
    count++;
  }
  const cut = { n: row, coords: found.coords.slice(0, 3 * count), masks: masks.slice(0, 16 * count) };
  return { ...cut, firstRows: found.firstRows.slice(0, 16 * count), index: new BrickIndex(n, cut.coords) };
}

export function bitCount(word) {
  let n = word - ((word >>> 1) & 0x55555555);
  n = (n & 0x33333333) + ((n >>> 2) & 0x33333333);
  return Math.imul((n + (n >>> 4)) & 0x0f0f0f0f, 0x01010101) >>> 24;
}
