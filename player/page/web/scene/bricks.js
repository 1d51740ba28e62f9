// The bricks of one level, each with a mask of 512 bits, and a hash table that finds them by their coordinates. The twin
// of Bricks and Vertices in player/asset/pyramid.py.

// Pack a coordinate, three components from 0 to 511, into one integer. Integers are in the order of (x, y, z).
export const keyOf = (x, y, z) => (x << 18) | (y << 9) | z;
export const coordOf = (key) => [key >> 18, (key >> 9) & 511, key & 511];

export function popcount(word) {
  word -= (word >>> 1) & 0x55555555;
  word = (word & 0x33333333) + ((word >>> 2) & 0x33333333);
  return Math.imul((word + (word >>> 4)) & 0x0f0f0f0f, 0x01010101) >>> 24;
}

export class Bricks {
  // - keys: Int32Array [n], sorted, each at most once;
  // - masks: Uint32Array [16 n]: bit b = 64 x + 8 y + z of a brick is bit b & 31 of its word b >> 5.
  constructor(keys, masks) {
    this.keys = keys;
    this.masks = masks;
    this.bytes = new Uint8Array(masks.buffer, masks.byteOffset, 4 * masks.length); // byte 8 x + y of a brick: its bits along z
    this.n = keys.length;
    const size = 1 << Math.max(2, 32 - Math.clz32(2 * this.n));
    this.slots = new Int32Array(size).fill(-1);
    for (let i = 0; i < this.n; i++) {
      let slot = hash(keys[i]) & (size - 1);
      while (this.slots[slot] >= 0) slot = (slot + 1) & (size - 1);
      this.slots[slot] = i;
    }
  }

  // Return the index of the brick at a coordinate, -1 if there is none.
  find(x, y, z) {
    if ((x | y | z) < 0) return -1;
    const key = keyOf(x, y, z);
    const last = this.slots.length - 1;
    for (let slot = hash(key) & last; ; slot = (slot + 1) & last) {
      const i = this.slots[slot];
      if (i < 0 || this.keys[i] === key) return i;
    }
  }

  // Return the bricks whose masks are not all 0.
  withoutEmpty() {
    const kept = [];
    for (let i = 0; i < this.n; i++) {
      let some = 0;
      for (let word = 16 * i; word < 16 * i + 16; word++) some |= this.masks[word];
      if (some) kept.push(i);
    }
    if (kept.length === this.n) return this;
    const masks = new Uint32Array(16 * kept.length);
    kept.forEach((i, to) => masks.set(this.masks.subarray(16 * i, 16 * i + 16), 16 * to));
    return new Bricks(Int32Array.from(kept, (i) => this.keys[i]), masks);
  }
}

export const NO_BRICKS = new Bricks(new Int32Array(0), new Uint32Array(0));

function hash(key) {
  const mixed = Math.imul(key, 0x9e3779b1);
  return mixed ^ (mixed >>> 15);
}

// The numbers of the vertices of bricks, counted by brick and then by bit.
export class Ranks {
  constructor(bricks, masks) {
    this.bricks = bricks;
    this.masks = masks;
    this.first = new Int32Array(masks.length); // number of the first vertex of each word
    let n = 0;
    for (let word = 0; word < masks.length; word++) {
      this.first[word] = n;
      n += popcount(masks[word]);
    }
    this.n = n;
  }

  // Return the number of bit b of a brick; `none` if the bit is not set, or the brick is -1.
  at(brick, b, none) {
    if (brick < 0) return none;
    const word = 16 * brick + (b >> 5);
    const bits = this.masks[word];
    return (bits >>> (b & 31)) & 1 ? this.first[word] + popcount(bits & ((1 << (b & 31)) - 1)) : none;
  }
}
