// Uploads the arrays of a grid as WebGL2 textures, and makes the framebuffers that are drawn to.
import { blockOf, COLUMN_BRICK, DENSITY_BRICK, featureWords, LINES_A_LAYER, rowsALine } from "../scene/grid.js";

const MOST_LAYERS = 256; // layers of an array texture that every device has
const MOST_ROWS = 2 ** 24; // rows that textures.glsl can tell apart: it converts their numbers to float32

export const TILE = 256; // pixels along a side of a tile, drawn at a time, so that no driver takes the GPU for hung

// Return the size [3] in texels of the texture of n rows of features. Throws an Error if no texture holds them.
function featureSize(n, nChannels) {
  const lines = Math.max(Math.ceil(n / rowsALine(nChannels)), 1), layers = Math.ceil(lines / LINES_A_LAYER);
  if (n > MOST_ROWS || layers > MOST_LAYERS) throw new Error(`memory of the GPU: expected at most ${MOST_ROWS} rows of features, got ${n}`);
  return [rowsALine(nChannels) * featureWords(nChannels), Math.min(lines, LINES_A_LAYER), layers];
}

const product = (numbers) => numbers.reduce((all, number) => all * number, 1);

// Return the bytes of a grid's textures and of the framebuffers of a tile. The twin of `gpu_bytes` in
// player/page/gpu_memory.py.
export function gpuBytes({ nb, nf, density, columns, nRows }, nChannels) {
  const tile = TILE * TILE * (16 * Math.ceil(nChannels / 8) + 8 + 4);
  return 4 * (nb ** 3 + nf ** 3) + density.byteLength + columns.byteLength + 4 * product(featureSize(nRows, nChannels)) + tile;
}

export function uploadGrid(gl, { nb, nf, nSlots, nHeld, nRows, ...grid }, nChannels) {
  const { TEXTURE_3D, TEXTURE_2D_ARRAY } = gl;
  const density = blockOf(nSlots, DENSITY_BRICK).size, columns = blockOf(nHeld, COLUMN_BRICK).size;
  const features = featureSize(nRows, nChannels);
  const made = {
    uTable: [TEXTURE_3D, [nb, nb, nb], [gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE], grid.table],
    uDensity: [TEXTURE_3D, density, [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], grid.density],
    uOwners: [TEXTURE_3D, [nf, nf, nf], [gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE], grid.owners],
    uColumns: [TEXTURE_3D, columns, [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT], grid.columns],
    uFeatures: [TEXTURE_2D_ARRAY, features, [gl.RGBA8_SNORM, gl.RGBA, gl.BYTE], grid.features],
  };
  for (const [target, size] of Object.values(made)) checkSize(gl, target, size); // before any texture takes memory
  return Object.fromEntries(Object.entries(made).map(([name, given]) => [name, texture3D(gl, ...given)]));
}

function checkSize(gl, target, [width, height, depth]) {
  const most = gl.getParameter(target === gl.TEXTURE_3D ? gl.MAX_3D_TEXTURE_SIZE : gl.MAX_TEXTURE_SIZE);
  const largest = Math.max(width, height, target === gl.TEXTURE_3D ? depth : 0);
  if (most === null || largest <= most) return; // most is null if the context is lost
  throw new Error(`memory of the GPU: expected textures of ${largest} texels a side, got at most ${most}`);
}

// Return whether the bound framebuffer can be drawn to; true if the context is lost.
export function isComplete(gl) {
  return gl.isContextLost() || gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
}

// Throw an Error if the GPU's memory was too small for `what`: if it has run out since the last call, or if the
// bound framebuffer is incomplete.
export function checkMemory(gl, what) {
  const errors = [];
  for (let error = gl.getError(); error !== gl.NO_ERROR; error = gl.getError()) errors.push(error);
  if (gl.isContextLost() || (isComplete(gl) && !errors.includes(gl.OUT_OF_MEMORY))) return;
  throw new Error(`memory of the GPU: expected enough for ${what}, got too little`);
}

function fresh(gl, target) {
  const texture = gl.createTexture();
  gl.bindTexture(target, texture);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, filter, gl.NEAREST);
  for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, wrap, gl.CLAMP_TO_EDGE);
  return { texture, target };
}

// Make a texture of a size [3] with the formats [internal format, format, type]. It is filled with `values` line by line,
// as far as they reach.
function texture3D(gl, target, [width, height, depth], [inside, format, type], values) {
  const found = fresh(gl, target), line = 4 * width;
  gl.texStorage3D(target, 1, inside, width, height, depth);
  const put = (x, y, z, w, h, d, from) => {
    if (w && h && d) gl.texSubImage3D(target, 0, x, y, z, w, h, d, format, type, values, from);
  };
  const lines = Math.floor(values.length / line), layers = Math.floor(lines / height), rest = lines % height;
  put(0, 0, 0, width, height, layers, 0);
  put(0, 0, layers, width, rest, 1, layers * height * line);
  put(0, rest, layers, (values.length % line) / 4, 1, 1, lines * line);
  return found;
}

// Upload the lattice that contracted.glsl reads: s, cos(s) and sin(s) at each of n half base steps.
export function uploadLattice(gl, step) {
  const single = Math.fround(step), n = 2 * Math.floor(Math.PI / step) + 4, values = new Float32Array(4 * n);
  for (let i = 0; i < n; i++) {
    const s = Math.fround(0.5 * (i + 1) * single);
    values.set([s, Math.cos(s), Math.sin(s), 0], 4 * i);
  }
  return { ...uploadFloats(gl, values), n };
}

// Upload numbers [4 n] as a texture of four float32 per texel, in rows of 1024 texels.
export function uploadFloats(gl, values) {
  const height = Math.ceil(values.length / 4096), padded = new Float32Array(4096 * height);
  padded.set(values);
  const found = fresh(gl, gl.TEXTURE_2D);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, 1024, height);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 1024, height, gl.RGBA, gl.FLOAT, padded);
  return found;
}

// Make a framebuffer with a texture of each format, and bind it: { framebuffer, textures, width, height }.
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
