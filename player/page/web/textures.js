// The arrays of a grid as textures of WebGL2. A long array lies in a layered texture, row by row: every device has
// textures of 2048 x 2048 texels and 256 layers.
import { featureWords } from "./grid.js";

export const WIDTH_BITS = 11;
const MOST_BITS = 11, MOST_LAYERS = 256, LEAST_BITS = 6;

// How an array of n texels lies: `bits` of a row's number in its layer, and layers.
export function layoutOf(n) {
  const rows = Math.max(Math.ceil(n / 2 ** WIDTH_BITS), 1);
  let bits = Math.min(Math.ceil(Math.log2(rows)), LEAST_BITS);
  while (rows > MOST_LAYERS * 2 ** bits) bits++;
  if (bits > MOST_BITS) throw new Error(`memory of the GPU: expected at most ${MOST_LAYERS * 2 ** (MOST_BITS + WIDTH_BITS)} texels of a kind, got ${n}`);
  return { bits, layers: Math.ceil(rows / 2 ** bits) };
}

const bytesOf = (n, words) => {
  const { bits, layers } = layoutOf(n);
  return layers * 2 ** (bits + WIDTH_BITS) * 4 * words;
};

// Texels of features, and the words in each.
export function featureLayout(nRows, nChannels) {
  const words = featureWords(nChannels), wide = Math.min(words, 4);
  return { n: Math.ceil((nRows * words) / wide), words: wide };
}

// The `bits` of a grid's long arrays: densities, columns and features.
export function rowBits({ nSlots, nHeld, nRows }, nChannels) {
  return [162 * nSlots, 81 * nHeld, featureLayout(nRows, nChannels).n].map((n) => layoutOf(n).bits);
}

export const TILE = 256; // pixels along a side of what is drawn at a time, so that no driver takes it for hung

// Bytes of a grid's textures, and of what a tile of the picture takes. The twin of player/page/gpu_memory.py.
export function gpuBytes({ nb, nf, nSlots, nHeld, nRows }, nChannels) {
  const features = featureLayout(nRows, nChannels);
  const tile = TILE * TILE * (16 * Math.ceil(nChannels / 8) + 8 + 4);
  return 4 * (nb ** 3 + nf ** 3) + bytesOf(162 * nSlots, 2) + bytesOf(81 * nHeld, 2) + bytesOf(features.n, features.words) + tile;
}

export function uploadGrid(gl, grid, nChannels) {
  const most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE), largest = Math.max(grid.nb, grid.nf);
  if (largest > most) throw new Error(`memory of the GPU: expected textures of ${largest} texels a side, got at most ${most}`);
  const { words } = featureLayout(grid.nRows, nChannels);
  return {
    uTable: cube(gl, grid.nb, grid.table),
    uDensity: layered(gl, grid.density, 2),
    uOwners: cube(gl, grid.nf, grid.owners),
    uColumns: layered(gl, grid.columns, 2),
    uFeatures: layered(gl, grid.features, words),
  };
}

function fresh(gl, target) {
  const texture = gl.createTexture();
  gl.bindTexture(target, texture);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, filter, gl.NEAREST);
  for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, wrap, gl.CLAMP_TO_EDGE);
  return { texture, target };
}

function cube(gl, n, values) {
  const found = fresh(gl, gl.TEXTURE_3D);
  gl.texStorage3D(gl.TEXTURE_3D, 1, gl.R32I, n, n, n);
  gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, n, n, n, gl.RED_INTEGER, gl.INT, values);
  return found;
}

function layered(gl, values, words) {
  const target = gl.TEXTURE_2D_ARRAY, n = values.length / words, width = 2 ** WIDTH_BITS;
  const { bits, layers } = layoutOf(n), height = 2 ** bits;
  const found = fresh(gl, target);
  const [inside, format] = { 1: [gl.R32UI, gl.RED_INTEGER], 2: [gl.RG32UI, gl.RG_INTEGER], 4: [gl.RGBA32UI, gl.RGBA_INTEGER] }[words];
  gl.texStorage3D(target, 1, inside, width, height, layers);
  const rows = Math.floor(n / width), rest = n % width;
  const put = (row, count, across) => {
    if (count) {
      gl.texSubImage3D(target, 0, 0, row % height, Math.floor(row / height), across, count, 1, format, gl.UNSIGNED_INT, values, row * width * words);
    }
  };
  for (let row = 0; row < rows; row += height) put(row, Math.min(height, rows - row), width);
  if (rest) put(rows, 1, rest);
  return found;
}

// s, its cosine and its sine at every half base step, as the march of contracted space reads them.
export function uploadLattice(gl, step) {
  const single = Math.fround(step), n = 2 * Math.floor(Math.PI / step) + 4, values = new Float32Array(4 * n);
  for (let i = 0; i < n; i++) {
    const s = Math.fround(0.5 * (i + 1) * single);
    values.set([s, Math.cos(s), Math.sin(s), 0], 4 * i);
  }
  return { ...uploadFloats(gl, values), n };
}

// Texels of four numbers [4 n], in rows of 1024.
export function uploadFloats(gl, values) {
  const height = Math.ceil(values.length / 4096), padded = new Float32Array(4096 * height);
  padded.set(values);
  const found = fresh(gl, gl.TEXTURE_2D);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, 1024, height);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 1024, height, gl.RGBA, gl.FLOAT, padded);
  return found;
}

// A framebuffer with textures of such formats, bound: { framebuffer, textures, width, height }.
export function framebufferOf(gl, width, height, formats) {
  gl.activeTexture(gl.TEXTURE0);
  const textures = formats.map((format) => {
    const found = fresh(gl, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    return found;
  });
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  const places = textures.map(({ texture }, i) => {
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
    return gl.COLOR_ATTACHMENT0 + i;
  });
  gl.drawBuffers(places);
  return { framebuffer, textures, width, height };
}

export function deleteFramebuffer(gl, { framebuffer, textures }) {
  for (const { texture } of textures) gl.deleteTexture(texture);
  gl.deleteFramebuffer(framebuffer);
}
