// Writes the shaders of a scene, from the texts of the .glsl files, and compiles them.
import { featureWords, LINES_A_LAYER, MANY, NO_LEVEL, rowsALine } from "../scene/grid.js";
import { headCode } from "./head.js";
import { shaders } from "../shaders.js";

export const LAYERS = ["colour", "depth", "normals", "opacity", "middle"];
const KEPT = 64; // samples that are kept per ray: see fetches.glsl

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1);
}
`;

// Return the texts that replace names in the shaders, which depend on the number of channels.
function featureTexts(nChannels) {
  const n = featureWords(nChannels), numbers = Array.from({ length: n }, (_, i) => i);
  const nWords = 2 * n, nOut = foundTextures(nChannels);
  const outputs = Array.from({ length: nOut }, (_, i) => `layout(location = ${i}) out uvec4 found${i};\n`);
  const word = (i) => (i < nWords ? `packSnorm2x16(f${i >> 1}.${i & 1 ? "zw" : "xy"} * share)` : "0u");
  const write = Array.from({ length: nOut }, (_, i) => `found${i} = uvec4(${[0, 1, 2, 3].map((c) => word(4 * i + c)).join(", ")});`);
  return {
    FEATURES: `vec4 ${numbers.map((i) => `f${i}`).join(", ")};`,
    ADD_ROW: numbers.map((i) => `f${i} += share * featureAt(at + ivec3(${i}, 0, 0));`).join("\n"),
    LARGEST_FEATURES: numbers.map((i) => `abs(f${i})`).reduce((a, b) => `max(${a}, ${b})`),
    CLEAR_FEATURES: numbers.map((i) => `f${i} = `).join("") + "vec4(0);",
    FOUND_OUTPUTS: `${outputs.join("")}layout(location = ${nOut}) out uvec4 foundOpacity;`,
    WRITE_FOUND: write.join("\n"),
    FOUND_INPUTS: Array.from({ length: nOut }, (_, i) => `uniform highp usampler2D uFound${i};`).join("\n"),
    READ_FEATURES: Array.from({ length: nOut }, (_, i) => {
      const put = (j, pair) => (j < n ? [`memory[FEATURES_AT + ${j}][p] = unpackedPair(${pair}) * scale;`] : []);
      return [`uvec4 u${i} = texelFetch(uFound${i}, at, 0);`, ...put(2 * i, `u${i}.x, u${i}.y`), ...put(2 * i + 1, `u${i}.z, u${i}.w`)].join("\n");
    }).join("\n"),
  };
}

// Number of textures, of eight features each, that the march writes for the head. One more has the opacity.
export const foundTextures = (nChannels) => Math.ceil(nChannels / 8);

const BEGIN = "#version 300 es\n";
const PRECISION = "precision highp float;\nprecision highp int;\n";

function filled(text, texts) {
  return text.replace(new RegExp(`\\b(${Object.keys(texts).join("|")})\\b`, "g"), (name) => texts[name]);
}

// Return the fragment shader that marches rays and draws a layer; for "colour" it writes what the head needs instead.
// `mostSteps`: the most base steps that a ray can have.
export function marchSource(scene, { layer, counting, mostSteps }) {
  const { manifest } = scene, nChannels = manifest.n_channels;
  const defines = {
    LAYER: LAYERS.indexOf(layer), MOST_STEPS: mostSteps, KEPT, MANY, NO_LEVEL,
    WORDS: featureWords(nChannels), ROWS_A_LINE: rowsALine(nChannels), LINES_A_LAYER,
    ...(layer === "normals" ? { NORMALS: 1 } : {}), ...(counting ? { COUNTING: 1 } : {}),
  };
  const features = layer === "colour" ? ["features"] : [];
  const parts = ["rays", "textures", manifest.contracted ? "contracted" : "box", "march", ...features, "fetches", "pixel"];
  const text = parts.map((name) => shaders[`${name}.glsl`]).join("\n");
  const lines = Object.entries(defines).map(([name, value]) => `#define ${name} ${value}\n`);
  return BEGIN + lines.join("") + PRECISION + filled(text, featureTexts(nChannels));
}

// Return the fragment shader of the head, and the numbers that the shader reads: { source, weights, table }.
export function headSource(scene) {
  const { texts, weights, table } = headCode(scene.head);
  const text = filled(filled(shaders["head.glsl"], { ...featureTexts(scene.manifest.n_channels), ...texts }), texts);
  return { source: BEGIN + PRECISION + shaders["rays.glsl"] + text, weights, table };
}

export const compositeSource = () => BEGIN + PRECISION + shaders["composite.glsl"];

// A program. The constructor only starts compiling and linking, and the driver goes on in the background.
export class Program {
  constructor(gl, fragment) {
    this.gl = gl;
    this.uniforms = null; // place and type of each uniform by name, once linked
    this.program = gl.createProgram();
    this.shaders = [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]].map(([kind, text]) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
      return shader;
    });
    gl.linkProgram(this.program);
  }

  // Wait until the program is linked. Throws an Error with the driver's message if it cannot be linked.
  link() {
    const { gl, program, shaders } = this;
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const said = [gl.getProgramInfoLog(program), ...shaders.map((shader) => gl.getShaderInfoLog(shader))];
      throw new Error(`shader: ${said.filter(Boolean).join(" ").slice(0, 500)}`);
    }
    for (const shader of shaders) gl.deleteShader(shader);
    this.uniforms = new Map();
    const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
    for (let i = 0; i < count; i++) {
      const { name, type } = gl.getActiveUniform(program, i);
      this.uniforms.set(name.replace("[0]", ""), { place: gl.getUniformLocation(program, name), type });
    }
  }

  // Make this the current program and set its uniforms. `values`: numbers, arrays, booleans, or textures { texture, target },
  // by the uniforms' names; values for uniforms that the program does not have are ignored.
  use(values) {
    const { gl } = this;
    if (!this.uniforms) this.link();
    gl.useProgram(this.program);
    let unit = 0;
    for (const [name, { place, type }] of this.uniforms) {
      const value = values[name];
      if (value === undefined) continue;
      if (value.texture) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(value.target, value.texture);
        gl.uniform1i(place, unit++);
      } else if (type === gl.FLOAT_MAT3) gl.uniformMatrix3fv(place, false, value);
      else if (type === gl.INT || type === gl.BOOL) gl.uniform1iv(place, [value].flat().map(Number));
      else gl[`uniform${{ [gl.FLOAT]: 1, [gl.FLOAT_VEC2]: 2, [gl.FLOAT_VEC3]: 3, [gl.FLOAT_VEC4]: 4 }[type]}fv`](place, [value].flat());
    }
  }
}
