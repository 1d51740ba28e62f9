// Decodes blocks of small integers by interleaved rANS with contexts (docs/format.md, "Coder"). The twin of
// player/asset/coder, which uses the same names.

const END = 63; // the largest magnitude in a table; one further byte is added to symbols coded as -63 or 63
const N_SYMBOLS = 2 * END + 1;
const BITS = 12;
const TOTAL = 1 << BITS;
const MAX_TABLES = 64;
const MAX_LANES = 4096;
const MAX_SYMBOL = 255;
const N_CONTEXTS = 81;
const NEAR = 15;
const HALF = 64;
const SUM_STEPS = [1, 2, 3, 5, 8, 12, 18, 30];
const LEAN_STEPS = [1, 2, 4, 8];

// For each symbol + 63: the symbol s, clipped to -15 ... 15, as 128 |s| + s, so that one sum adds magnitudes and symbols.
const MIXED = Int16Array.from({ length: N_SYMBOLS }, (_, i) => {
  const near = Math.max(-NEAR, Math.min(NEAR, i - END));
  return 128 * Math.abs(near) + near;
});

// The context, without its class, for each sum of the MIXED of the three neighbours, plus HALF.
const CONTEXT_OF_SUM = Uint8Array.from({ length: (3 * NEAR + 1) << 7 }, (_, i) => {
  const total = i >> 7;
  const lean = i - HALF - (total << 7);
  const rise = SUM_STEPS.filter((most) => most <= total).length;
  const side = LEAN_STEPS.filter((most) => most <= Math.abs(lean)).length * Math.sign(lean);
  return rise * (2 * LEAN_STEPS.length + 1) + side + LEAN_STEPS.length;
});

// Unpack a zlib stream to at most `most` bytes; null if the stream is broken or holds more.
async function inflated(bytes, most) {
  const found = new Uint8Array(most);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const reader = stream.getReader();
  let length = 0;
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return found.subarray(0, length);
      if (length + value.length > most) {
        reader.cancel().catch(() => {});
        return null;
      }
      found.set(value, length);
      length += value.length;
    }
  } catch {
    return null;
  }
}

// Unpack the tables of a block: { symbols, entries, ofContext, hasEnds }. `symbols` [n_tables * 4096] has the symbol + 63 at
// each place; `entries` [n_tables * 128], for each symbol + 63, its count times 4096 plus its first place; `ofContext`
// [nNamed] the table of each context. `hasEnds`: whether a symbol can be -63 or 63.
async function unpackTables(bytes, nNamed, where) {
  const content = await inflated(bytes, nNamed + 1 + MAX_TABLES * (2 + 2 * N_SYMBOLS));
  if (!content || content.length <= nNamed) throw new Error(`${where}: tables: expected one whole zlib stream`);
  const nTables = content[nNamed];
  let at = nNamed + 1 + 2 * nTables;
  if (nTables < 1 || nTables > MAX_TABLES || at > content.length) {
    throw new Error(`${where}: tables: expected 1 to ${MAX_TABLES}`);
  }
  const ofContext = content.subarray(0, nNamed);
  for (let i = 0; i < nNamed; i++) {
    if (ofContext[i] >= nTables) throw new Error(`${where}: tables: expected contexts that name one of them`);
  }
  const symbols = new Uint8Array(nTables * TOTAL);
  const entries = new Int32Array(nTables * 128);
  let hasEnds = false;
  for (let table = 0; table < nTables; table++) {
    const first = content[nNamed + 1 + 2 * table];
    const n = content[nNamed + 2 + 2 * table];
    if (first + n > N_SYMBOLS || at + 2 * n > content.length) {
      throw new Error(`${where}: tables: expected counts of symbols from -${END} to ${END}`);
    }
    let place = 0;
    for (let symbol = first; symbol < first + n; symbol++, at += 2) {
      const count = content[at] | (content[at + 1] << 8);
      if (place + count > TOTAL) break;
      symbols.fill(symbol, table * TOTAL + place, table * TOTAL + place + count);
      entries[table * 128 + symbol] = (count << BITS) | (place & (TOTAL - 1));
      hasEnds ||= count > 0 && (symbol === 0 || symbol === N_SYMBOLS - 1);
      place += count;
    }
    if (place !== TOTAL) throw new Error(`${where}: tables: expected counts that add up to ${TOTAL}`);
  }
  if (at !== content.length) throw new Error(`${where}: tables: expected nothing behind the counts`);
  return { symbols, entries, ofContext, hasEnds };
}

// A decoder of a block, which is read channel by channel.
export class Decoder {
  // - bytes: the bytes of the block;
  // - neighbours: [alongZ, alongY, alongX], each Int32Array [n]: the row one step before each row on that axis, n if none;
  // - nChannels, nClasses: the numbers of channels and of classes with which the block was encoded;
  // - where: the section's name in error messages.
  // Rejects with an Error if `bytes` are not a block of so many rows and channels. Memory is bounded by the number of
  // rows, by the length of `bytes`, and by 2 MB.
  static async open(bytes, neighbours, nChannels, nClasses, where) {
    const n = neighbours[0].length;
    const decoder = new Decoder();
    Object.assign(decoder, { where, nChannels, nClasses, n, channelsDone: 0 });
    decoder.isEmpty = n * nChannels === 0;
    if (decoder.isEmpty) {
      if (bytes.length) throw new Error(`${where}: expected no bytes for no symbols, got ${bytes.length}`);
      return decoder;
    }
    if (bytes.length < 12) throw new Error(`${where}: expected a header of 12 bytes, got ${bytes.length}`);
    const header = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
    const [nLanes, nPacked, nWords] = [0, 4, 8].map((at) => header.getUint32(at, true));
    if (nLanes < 1 || nLanes > Math.min(MAX_LANES, n)) {
      throw new Error(`${where}: lanes: expected 1 to ${Math.min(MAX_LANES, n)}, got ${nLanes}`);
    }
    const begin = 12 + nPacked;
    const wordsBegin = begin + 4 * nLanes;
    const end = wordsBegin + 2 * nWords;
    if (bytes.length < end) throw new Error(`${where}: expected at least ${end} bytes, got ${bytes.length}`);
    decoder.tables = await unpackTables(bytes.subarray(12, begin), nChannels * nClasses * N_CONTEXTS, where);
    decoder.states = new Int32Array(bytes.slice(begin, wordsBegin).buffer);
    if (decoder.states.some((state) => state >>> 16 === 0)) throw new Error(`${where}: states: expected 65536 or more`);
    decoder.words = new Uint16Array(nWords + nLanes);
    decoder.words.set(new Uint16Array(bytes.slice(wordsBegin, end).buffer));
    decoder.nWords = nWords;
    decoder.wordsTaken = 0;
    // For each symbol of -63 or 63, channel by channel and row by row: how much further from 0 it is.
    decoder.beyond = bytes.subarray(end);
    if (decoder.beyond.some((more) => more > MAX_SYMBOL - END)) {
      throw new Error(`${where}: symbols: expected magnitudes up to ${MAX_SYMBOL}`);
    }
    decoder.beyondTaken = 0;
    decoder.beside = inOrder(neighbours, nLanes);
    decoder.symbols = new Uint8Array(n + 1).fill(SYMBOL_OF_ZERO); // of the last channel, + 63; the last stands for no row
    return decoder;
  }

  // Decode the next channel, whose `classes` Uint8Array [n] are given, into `found` Uint8Array [n], as symbols + 63. Returns
  // how many bytes of `beyond` belong to earlier channels. Throws an Error if the block is damaged.
  channel(classes, found) {
    if (this.isEmpty) return 0;
    const { n, tables, states, words, beside, symbols } = this;
    const ofContext = tables.ofContext.slice(
      this.channelsDone * this.nClasses * N_CONTEXTS,
      (this.channelsDone + 1) * this.nClasses * N_CONTEXTS,
    );
    this.wordsTaken = decodeChannel(
      words, this.wordsTaken, states, tables.symbols, tables.entries, ofContext, classes, beside, symbols,
    );
    if (this.wordsTaken < 0) throw new Error(`${this.where}: words: expected more than ${this.nWords}`);
    found.set(symbols.subarray(0, n));
    this.channelsDone++;
    const before = this.beyondTaken;
    if (tables.hasEnds) {
      for (let row = 0; row < n; row++) if (found[row] === 0 || found[row] === 2 * END) this.beyondTaken++;
      if (this.beyondTaken > this.beyond.length) {
        throw new Error(`${this.where}: symbols beyond ${END}: expected more than ${this.beyond.length}`);
      }
    }
    return before;
  }

  // Throw an Error unless all channels, all words and all bytes of `beyond` have been read, and every state is 2^16, with
  // which encoding began.
  finish() {
    if (this.isEmpty) return;
    if (this.channelsDone !== this.nChannels || this.wordsTaken !== this.nWords) {
      throw new Error(`${this.where}: words: expected ${this.wordsTaken}, got ${this.nWords}`);
    }
    if (this.beyondTaken !== this.beyond.length) {
      throw new Error(`${this.where}: symbols beyond ${END}: expected ${this.beyondTaken}, got ${this.beyond.length}`);
    }
    if (this.states.some((state) => state !== 1 << 16)) throw new Error(`${this.where}: damaged: states do not end`);
  }
}

// Return Int32Array [3 n]: the three neighbours of each row, with the rows in the order of decoding. A neighbour that is
// not decoded at an earlier step is replaced by n.
function inOrder([alongZ, alongY, alongX], nLanes) {
  const n = alongZ.length;
  const nSteps = Math.floor(n / nLanes);
  const nLonger = n % nLanes;
  const steps = new Int32Array(n + 1);
  steps[n] = n;
  const beside = new Int32Array(3 * n);
  for (let lane = 0, row = 0; lane < nLanes; lane++) {
    const first = row;
    const end = first + (lane < nLonger ? nSteps + 1 : nSteps);
    for (let to = 3 * lane; row < end; row++, to += 3 * nLanes) {
      const step = row - first;
      steps[row] = step;
      const z = alongZ[row], y = alongY[row], x = alongX[row];
      beside[to] = z >= first || steps[z] < step ? z : n; // in a lane, neighbours come before their row
      beside[to + 1] = y >= first || steps[y] < step ? y : n;
      beside[to + 2] = x >= first || steps[x] < step ? x : n;
    }
  }
  return beside;
}

// Decode the symbols + 63 of a channel into `found` [n + 1], whose last element stays as it is. Returns how many words
// have been taken by then, or -1 if there are too few.
function decodeChannel(words, at, states, symbolOf, entries, ofContext, classes, beside, found) {
  const n = classes.length;
  const nLanes = states.length;
  const nWords = words.length - nLanes;
  const nSteps = Math.floor(n / nLanes);
  const nLonger = n % nLanes;
  let from = 0;
  for (let step = 0; step <= nSteps; step++) {
    const nActive = step < nSteps ? nLanes : nLonger;
    let row = step;
    for (let lane = 0; lane < nActive; lane++) {
      const total = MIXED[found[beside[from]]] + MIXED[found[beside[from + 1]]] + MIXED[found[beside[from + 2]]] + HALF;
      from += 3;
      const table = ofContext[classes[row] * N_CONTEXTS + CONTEXT_OF_SUM[total]];
      let x = states[lane];
      const place = x & (TOTAL - 1);
      const symbol = symbolOf[(table << BITS) | place];
      const entry = entries[(table << 7) | symbol];
      x = (Math.imul(entry >> BITS, x >>> BITS) + place - (entry & (TOTAL - 1))) | 0;
      if (x >>> 16 === 0) x = (x << 16) | words[at++];
      states[lane] = x;
      found[row] = symbol;
      row += lane < nLonger ? nSteps + 1 : nSteps;
    }
    if (at > nWords) return -1;
  }
  return at;
}

export const SYMBOL_OF_ZERO = END;
