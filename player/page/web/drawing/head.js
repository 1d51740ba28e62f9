// Writes the head as a shader: a loop over its layers, whose weights are texels of a texture. The shader computes four pixels
// at a time, so that each weight is fetched once for all of them. The code of a layer is in the shader only once, because
// drivers take long to compile much code. The twin of player/head/graph.py, which has the equations; the rounding to 8 bits
// is that of player/head/activations.py.

const AT_ONCE = 2; // texels of the outputs of a layer that head.glsl finds at a time, so that each input is read for all of them
const AS_IT_IS = 0, ACTIVATED = 1, ROUNDED = 2; // what is done to outputs: see head.glsl
const XYZW = "xyzw";
const fours = (n) => Math.ceil(n / 4);
const outputTexels = (n) => AT_ONCE * Math.ceil(fours(n) / AT_ONCE);

// Return the multiply-adds per pixel: those of the layers, and of the spherical harmonics.
export function multiplyAdds(head) {
  const layers = [...head.spatial, head.to_sh, head.bottleneck, head.from_sh, ...head.directional, head.output];
  const harmonics = head.harmonics.n_in * distinctColumns(head.harmonics).columns.length;
  return layers.reduce((sum, layer) => sum + layer.n_in * layer.n_out, harmonics);
}

// Find the harmonics that differ: { columns, which }. A column is a harmonic's bias and weights, and `which` tells for each
// encoded feature the column of the harmonic that multiplies it.
function distinctColumns({ n_in, n_out, weight, bias }) {
  const columns = [], which = [], known = new Map();
  for (let o = 0; o < n_out; o++) {
    const column = [bias[o], ...Array.from({ length: n_in }, (_, i) => weight[i * n_out + o])];
    const key = column.join();
    if (!known.has(key)) {
      known.set(key, columns.length);
      columns.push(column);
    }
    which.push(known.get(key));
  }
  return { columns, which };
}

// The layers as numbers: `weights` for the texture, `table` for uLayers. Vectors lie one behind the other in a memory of
// `size` texels; the place of a vector is its first texel there.
class Layers {
  constructor() {
    Object.assign(this, { weights: [], table: [], size: 0 });
  }

  // Reserve memory for a vector of up to n numbers; return its place.
  place(n) {
    this.size += outputTexels(n);
    return this.size - outputTexels(n);
  }

  // Add a layer: y = after((x W + bias) * scale), where x and y are places; with `add`, y = after(y + x W).
  dense(y, x, { n_in: nIn, n_out: nOut, weight, bias, scale }, { after = [AS_IT_IS, 0, 0], add = false } = {}) {
    const texel = (o, at) => {
      for (let c = 4 * o; c < 4 * o + 4; c++) this.weights.push(c < nOut ? at(c) : 0);
    };
    this.table.push(fours(nIn), outputTexels(nOut), x, y, this.weights.length / 4, ...after, Number(add), 0, 0, 0);
    for (let first = 0; first < outputTexels(nOut); first += AT_ONCE) {
      const some = Array.from({ length: AT_ONCE }, (_, i) => first + i);
      for (const o of some) texel(o, (c) => bias[c]);
      for (const o of some) texel(o, (c) => scale?.[c] ?? 1);
      for (let i = 0; i < 4 * fours(nIn); i += 4) {
        for (const o of some) for (let row = i; row < i + 4; row++) texel(o, (c) => (row < nIn ? weight[row * nOut + c] : 0));
      }
    }
  }
}

// Return { texts, weights, table }: the texts that replace names in head.glsl, the weights as texels [4 n], and the numbers
// of uLayers.
export function headCode(head) {
  const layers = new Layers(), roundings = [...head.roundings], { columns, which } = distinctColumns(head.harmonics);
  // Return what is done to the outputs of a layer that is activated: they are also rounded, as long as roundings are left
  // for a head in 8 bits.
  const activated = () => {
    if (!head.in_8_bits || !roundings.length) return [ACTIVATED, 0, 0];
    const { scale, zero } = roundings.shift();
    return [ROUNDED, 1 / scale, zero];
  };
  const widest = Math.max(head.n_channels, ...[...head.spatial, head.bottleneck, ...head.directional].map((layer) => layer.n_out));
  let here = layers.place(widest), there = layers.place(widest); // places of the last outputs, and of the next
  const places = { FEATURES_AT: here, MONOMIALS_AT: layers.place(head.harmonics.n_in), ENCODED_AT: layers.place(head.to_sh.n_out) };
  places.HARMONICS_AT = layers.place(columns.length);
  const swap = () => ([here, there] = [there, here]);
  head.spatial.forEach((layer, i) => {
    layers.dense(there, here, layer, { after: i + 1 < head.spatial.length ? [ACTIVATED, 0, 0] : activated() });
    swap();
  });
  layers.dense(places.ENCODED_AT, here, head.to_sh);
  layers.dense(places.HARMONICS_AT, places.MONOMIALS_AT, columnsLayer(head.harmonics.n_in, columns));
  layers.dense(there, here, head.bottleneck);
  layers.dense(there, places.ENCODED_AT, scaled(head.from_sh), { add: true, after: activated() });
  swap();
  for (const layer of head.directional) {
    layers.dense(there, here, layer, { after: activated() });
    swap();
  }
  layers.dense(there, here, head.output);
  const texts = {
    ...places, ACTIVATION: head.activation, COLOURS_AT: there, MEMORY: layers.size, N_LAYERS: layers.table.length / 12, HARMONICS_LAYER: head.spatial.length + 1,
    WRITE_MONOMIALS: monomialsCode(head.monomials), MULTIPLY_BY_HARMONICS: multiplyCode(which, head.of_encoded),
  };
  return { texts, weights: new Float32Array(layers.weights), table: layers.table };
}

// Return a layer that computes the distinct harmonics.
function columnsLayer(nIn, columns) {
  const nOut = columns.length, weight = new Float32Array(nIn * nOut);
  columns.forEach((column, o) => column.slice(1).forEach((w, i) => (weight[i * nOut + o] = w)));
  return { n_in: nIn, n_out: nOut, weight, bias: columns.map((column) => column[0]), scale: null };
}

// Return the code of texels that hold variables with the given names, and 0 in the rest of the last texel.
const texelsOf = (names) => Array.from({ length: fours(names.length) }, (_, o) => (
  `vec4(${[0, 1, 2, 3].map((c) => names[4 * o + c] ?? "0.0").join(", ")})`));

function monomialsCode(monomials) {
  const found = monomials.map(([parent, axis], i) => `float m${i} = ${parent < 0 ? "" : `m${parent} * `}direction.${XYZW[axis]};\n`);
  const texels = texelsOf(monomials.map((_, i) => `m${i}`)).map((texel, o) => `memory[MONOMIALS_AT + ${o}][p] = ${texel};\n`);
  return [...found, ...texels].join("");
}

// Return a layer whose weights have been multiplied by its scale, so that its sums need not be.
function scaled(layer) {
  if (!layer.scale) return layer;
  const weight = Float32Array.from(layer.weight, (w, i) => w * layer.scale[i % layer.n_out]);
  return { ...layer, weight, scale: null };
}

// Return the code that multiplies each encoded feature by its harmonic and, if `rounding` is given, rounds the product. It
// computes all four pixels at once, each in a column of a matrix.
function multiplyCode(which, rounding) {
  const columns = [0, 1, 2, 3].map((p) => texelsOf(which.map((i) => `memory[HARMONICS_AT + ${i >> 2}][${p}].${XYZW[i & 3]}`)));
  const product = (o) => `matrixCompMult(memory[ENCODED_AT + ${o}], mat4(${columns.map((texels) => texels[o]).join(", ")}))`;
  const { scale, zero } = rounding ?? {};
  const found = rounding ? (o) => `allRounded(${product(o)}, ${(1 / scale).toExponential()}, ${zero}.0)` : product;
  const multiply = (_, o) => `memory[ENCODED_AT + ${o}] = ${found(o)};\n`;
  return columns[0].map(multiply).join("");
}
