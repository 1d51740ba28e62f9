// Decodes the parts of a scene, one after another. The twin of player/asset/parts.py.

import { Decoder, SYMBOL_OF_ZERO } from "./coder.js";
import { Pyramid, putValues } from "./pyramid.js";
import { decodeStructure } from "./structure.js";

// The most bytes of memory that a scene may take while it is decoded: browsers end a page that asks for much more. The twin
// of MOST_DECODING_BYTES in player/page/gpu_memory.py.
const MOST_BYTES = 3200e6;

// One of the two pyramids, as far as its sections have been read. A level whose structure has not been read has no values,
// and a symbol that has not been read is 0. Values are computed from symbols when they are asked for, all channels of a
// level at once.
class PyramidReader {
  constructor(grid, manifest) {
    const isFeatures = grid === "features";
    this.steps = isFeatures ? manifest.feature_steps : manifest.density_steps;
    this.nChannels = isFeatures ? manifest.n_channels : 1;
    this.stride = isFeatures ? 4 * Math.ceil(this.nChannels / 4) : 1; // numbers from one row of values to the next
    [this.low, this.high] = isFeatures ? [-127, 127] : [0, 255];
    this.pyramid = new Pyramid(isFeatures ? manifest.feature_resolution : manifest.resolution, this.steps.length);
    this.nKnown = this.steps.map(() => 0); // for each level, how many channels have symbols that were read
    this.nPut = this.steps.map(() => 0); // for each level, how many channels have values computed from these
    this.symbols = this.steps.map(() => null); // of the channels from nPut on, channel by channel, + 63; null: all 0
    this.beyond = this.steps.map(() => []); // for those of these channels that were read, { bytes, first }: see putValues
    this.rows = null; // rows of the level whose symbols were read last
    this.rowsLevel = -1;
    // The first row of each level, the finest level first, and the rows of values of all levels that are known so far. They
    // grow with each level, so that a device whose memory is too small for a finer level keeps what it shows.
    this.firstRows = new Array(this.steps.length + 1).fill(0);
    this.all = new (isFeatures ? Int8Array : Uint8Array)(0);
  }

  valuesOf(level) {
    return this.all.subarray(this.firstRows[level] * this.stride, this.firstRows[level + 1] * this.stride);
  }

  async readStructure(section, data, where) {
    const { pyramid } = this;
    const coarser = pyramid.levels[section.level + 1] ?? null;
    const n = pyramid.cellsPerAxis(section.level);
    pyramid.setLevel(section.level, await decodeStructure(data, n, coarser, section.n_bricks, where));
    const found = pyramid.vertices[section.level].n;
    if (found !== section.n_vertices) {
      throw new Error(`${where}: n_vertices: expected ${found}, got ${section.n_vertices}`);
    }
    const coarserValues = this.all, nNew = found * this.stride;
    this.all = new coarserValues.constructor(nNew + coarserValues.length);
    this.all.set(coarserValues, nNew);
    this.firstRows = this.firstRows.map((row, other) => (other > section.level ? row + found : row));
  }

  async readSymbols(section, data, where, pause) {
    const { level, first_channel: first, n_channels: n } = section;
    if (this.rowsLevel !== level) {
      this.rows = null; // frees them before the next rows are made
      this.rows = this.pyramid.vertices[level].rows();
      this.rowsLevel = level;
    }
    const { rows } = this;
    const decoder = await Decoder.open(data, rows.neighbours, n, 4, where);
    const symbols = (this.symbols[level] ??= this.noSymbols(level));
    for (let channel = 0; channel < n; channel++) {
      const begin = (first - this.nPut[level] + channel) * rows.n;
      const before = decoder.channel(rows.classes, symbols.subarray(begin, begin + rows.n));
      this.beyond[level].push({ bytes: decoder.beyond, first: before });
      await pause();
    }
    decoder.finish();
    this.nKnown[level] = first + n;
  }

  noSymbols(level) {
    return new Uint8Array((this.nChannels - this.nPut[level]) * this.pyramid.vertices[level].nStored).fill(SYMBOL_OF_ZERO);
  }

  put(level) {
    const isCoarsest = level + 1 === this.steps.length, first = this.nPut[level];
    if (first === this.nChannels) return;
    putValues({
      here: this.pyramid.vertices[level],
      coarser: isCoarsest ? null : this.pyramid.vertices[level + 1],
      values: this.valuesOf(level),
      coarserValues: isCoarsest ? null : this.valuesOf(level + 1),
      stride: this.stride, first, n: this.nChannels - first,
      symbols: this.symbols[level] ?? this.noSymbols(level), beyond: this.beyond[level],
      step: this.steps[level], low: this.low, high: this.high,
    });
    this.nPut[level] = this.nKnown[level];
    this.symbols[level] = null;
    this.beyond[level] = [];
  }

  // Return what is known so far. `isLast`: nothing will be asked for afterwards, so that `values` may be the array itself
  // instead of a copy.
  values(isLast) {
    const { pyramid, nChannels, stride } = this;
    for (let level = this.steps.length - 1; level >= 0; level--) this.put(level);
    return {
      n_channels: nChannels,
      stride,
      levels: pyramid.levels,
      vertices: pyramid.vertices,
      values: isLast ? this.all : this.all.slice(),
      firstRows: this.firstRows,
    };
  }
}

// A reader of the sections of some `grids`, out of "densities" and "features", which skips the others' sections.
export class PartsReader {
  // `manifest`: the page's manifest, which Python has checked. Throws an Error if the scene takes more memory than
  // MOST_BYTES.
  constructor(manifest, grids) {
    this.manifest = manifest;
    const structures = manifest.parts.flatMap((part) => part.sections).filter((s) => s.kind === "structure");
    const nBytes = structures.reduce((sum, s) => sum + neededBytes(s, manifest), 0);
    if (nBytes > MOST_BYTES) {
      throw new Error(`the scene takes ${Math.ceil(nBytes / 1e6)} MB of memory: expected at most 3200 MB`);
    }
    this.grids = {};
    for (const grid of grids) this.grids[grid] = new PyramidReader(grid, manifest);
    this.nRead = 0;
  }

  // Read the next part, a Uint8Array. Rejects with an Error if the part breaks the format; as some of it may have been read
  // by then, the reader must not be used afterwards. `onProgress` is called with the bytes of each section that was read,
  // and `pause` is awaited between channels.
  async read(data, onProgress = () => {}, pause = async () => {}) {
    const part = this.manifest.parts[this.nRead];
    let at = 0;
    for (const section of part.sections) {
      const bytes = data.subarray(at, at + section.bytes);
      at += section.bytes;
      const where = `${part.file}: ${section.grid}, level ${section.level}, ${section.kind}`;
      const grid = this.grids[section.grid];
      if (!grid) continue;
      if (section.kind === "structure") await grid.readStructure(section, bytes, where);
      else await grid.readSymbols(section, bytes, where, pause);
      onProgress(section.bytes);
    }
    this.nRead++;
  }

  // Return what is known of each grid: { n_channels, stride, levels, vertices, values, firstRows }. `levels` are the Bricks of
  // each level, the finest first, `vertices` its Vertices. `values` [n_rows * stride], Uint8Array for densities, Int8Array for
  // features, has a row for each vertex, including those on the border. Rows are sorted by level, then by brick of vertices,
  // then by bit; those of features are padded to a multiple of four numbers. `firstRows` [n_levels + 1]: the first row of each
  // level, and the number of rows. Once all parts have been read, `values` may be the reader's own array: the caller may give
  // it away, and asks for nothing afterwards.
  values() {
    const isLast = this.nRead === this.manifest.parts.length;
    return Object.fromEntries(Object.entries(this.grids).map(([name, grid]) => [name, grid.values(isLast)]));
  }
}

// Return the most bytes of memory that a level takes. The bytes per brick and per vertex are those of the arrays in this
// module and in pyramid.js, including the rows of one level and the symbols of a section with all channels. The twin of
// `decoding_bytes` in player/page/gpu_memory.py.
function neededBytes(structure, manifest) {
  const nChannels = structure.grid === "features" ? manifest.n_channels : 1;
  return 2000 * structure.n_bricks + (40 + 2 * nChannels) * structure.n_vertices;
}
