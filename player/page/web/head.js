// The head as a shader: its layers as loops over a texture of weights, for four pixels at a time, so that each weight is
// fetched for all of them. The twin of player/head/graph.py, which has the equations; the rounding to 8 bits is that of
// player/head/activations.py.

export const HEAD_PIXELS = 4;
const XYZW = "xyzw";
const fours = (n) => Math.ceil(n / 4);

// Multiply-adds of a pixel: those of the layers, and of the spherical harmonics.
export function multiplyAdds(head) {
  const layers = [...head.spatial, head.to_sh, head.bottleneck, head.from_sh, ...head.directional, head.output];
  const harmonics = head.harmonics.n_in * distinctColumns(head.harmonics).columns.length;
  return layers.reduce((sum, layer) => sum + layer.n_in * layer.n_out, harmonics);
}

// The harmonics that differ, and which of them each encoded feature is multiplied by.
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

class Writer {
  constructor() {
    Object.assign(this, { weights: [], declared: [], code: [], count: 0 });
  }

  // A vector of n numbers for each pixel; its name, to which the pixel's number is added.
  vector(n) {
    const name = `v${this.count++}_`;
    for (let p = 0; p < HEAD_PIXELS; p++) this.declared.push(`vec4 ${name}${p}[${fours(n)}];`);
    return name;
  }

  // A line for each pixel, p.
  lines(line) {
    for (let p = 0; p < HEAD_PIXELS; p++) this.code.push(line(p));
  }

  // y = after((x W + bias) * scale), y[o] being `sums` beforehand; with `add`, y = after(y + x W).
  dense(y, x, layer, { after = (sum) => sum, add = false } = {}) {
    const { n_in: nIn, n_out: nOut, weight, bias, scale } = layer;
    const base = this.weights.length / 4, part = (some, o) => [0, 1, 2, 3].map((c) => (some && 4 * o + c < nOut ? some[4 * o + c] : 0));
    for (let o = 0; o < fours(nOut); o++) {
      for (let i = 0; i < 4 * fours(nIn); i++) {
        for (let c = 0; c < 4; c++) this.weights.push(i < nIn && 4 * o + c < nOut ? weight[i * nOut + 4 * o + c] : 0);
      }
      this.weights.push(...part(bias, o), ...(scale ? part(scale, o) : []));
    }
    const rows = 4 * fours(nIn), stride = rows + (scale ? 2 : 1);
    this.code.push(`for (int o = 0; o < ${fours(nOut)}; o++) {`, `int k = ${base} + o * ${stride};`, `vec4 b = weight(k + ${rows});`);
    this.lines((p) => `vec4 s${p} = ${add ? `${y}${p}[o]` : "b"};`);
    this.code.push(`for (int i = 0; i < ${fours(nIn)}; i++) {`, "vec4 w0 = weight(k), w1 = weight(k + 1), w2 = weight(k + 2), w3 = weight(k + 3);");
    this.lines((p) => `{ vec4 x = ${x}${p}[i]; s${p} += w0 * x.x + w1 * x.y + w2 * x.z + w3 * x.w; }`);
    this.code.push("k += 4;", "}");
    if (scale) this.code.push("b = weight(k + 1);");
    this.lines((p) => `${y}${p}[o] = ${after(scale ? `s${p} * b` : `s${p}`)};`);
    this.code.push("}");
  }
}

const number = (x) => (Number.isInteger(x) ? `${x}.0` : x.toPrecision(9));

// { code, weights }: the body of head.glsl's function, and the texels [4 n] that it reads.
export function headCode(head) {
  const writer = new Writer(), roundings = [...head.roundings];
  // What is done to the outputs of a layer; those of the last layer before a rounded one are rounded.
  const activated = () => {
    if (!head.in_8_bits || !roundings.length) return (sum) => `gelu(${sum})`;
    const { scale, zero } = roundings.shift();
    return (sum) => `rounded(gelu(${sum}), ${number(Math.fround(1 / scale))}, ${number(zero)})`;
  };
  const plain = (sum) => `gelu(${sum})`;
  let h = "f";
  head.spatial.forEach((layer, i) => {
    const y = writer.vector(layer.n_out);
    writer.dense(y, h, layer, { after: i + 1 < head.spatial.length ? plain : activated() });
    h = y;
  });
  const encoded = writer.vector(head.to_sh.n_out);
  writer.dense(encoded, h, head.to_sh);
  multiplyByHarmonics(writer, head, encoded);
  let z = writer.vector(head.bottleneck.n_out);
  writer.dense(z, h, head.bottleneck);
  writer.dense(z, encoded, head.from_sh, { add: true, after: activated() });
  for (const layer of head.directional) {
    const y = writer.vector(layer.n_out);
    writer.dense(y, z, layer, { after: activated() });
    z = y;
  }
  const rgb = writer.vector(3);
  writer.dense(rgb, z, head.output);
  writer.lines((p) => `rgb[${p}] = 1.0 / (1.0 + exp(-${rgb}${p}[0].xyz));`);
  return { code: [...writer.declared, ...writer.code].join("\n"), weights: new Float32Array(writer.weights) };
}

function multiplyByHarmonics(writer, head, encoded) {
  const { columns, which } = distinctColumns(head.harmonics);
  const nIn = head.harmonics.n_in, nOut = columns.length;
  const monomials = writer.vector(Math.max(nIn, 1)), harmonics = writer.vector(nOut);
  const component = (name, p, i) => `${name}${p}[${i >> 2}].${XYZW[i & 3]}`;
  writer.lines((p) => `${monomials}${p}[${Math.max(fours(nIn), 1) - 1}] = vec4(0);`);
  head.monomials.forEach(([parent, axis], i) => {
    const factor = (p) => (parent < 0 ? "" : `${component(monomials, p, parent)} * `);
    writer.lines((p) => `${component(monomials, p, i)} = ${factor(p)}direction[${p}].${XYZW[axis]};`);
  });
  const weight = new Float32Array(nIn * nOut);
  columns.forEach((column, o) => column.slice(1).forEach((w, i) => (weight[i * nOut + o] = w)));
  writer.dense(harmonics, monomials, { n_in: nIn, n_out: nOut, weight, bias: columns.map((column) => column[0]), scale: null });
  for (let o = 0; o < fours(which.length); o++) {
    const some = [0, 1, 2, 3].map((c) => which[Math.min(4 * o + c, which.length - 1)]);
    writer.lines((p) => `${encoded}${p}[${o}] *= vec4(${some.map((i) => component(harmonics, p, i)).join(", ")});`);
  }
}
