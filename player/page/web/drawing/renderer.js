// Draws a scene with WebGL2, to its canvas or into an array of bytes.
//
// A view is { c2w: [16], row-major, OpenGL axes, world frame, fx, fy, cx, cy, width, height, quality: "exact" | "high" |
// "fast", background: [r, g, b] | "transparent", layer: "colour" | "depth" | "normals" | "opacity", jitter: [dx, dy],
// accumulate, n_fetches }. By default `background` is the manifest's, `quality` is "high" ("exact" for `render`), and
// `layer` is "colour". `jitter` shifts the rays by fractions of a pixel. With `accumulate` the canvas shows the mean of
// the pictures drawn since the last one without it. A picture that cannot be added up, because its layer is not "colour" or
// the graphics card draws no sums, is drawn without jitter. `n_fetches` replaces the quality's feature lookups per ray; 0
// looks features up at every sample.
import { raysOf } from "./camera.js";
import { NO_GRID } from "../scene/grid.js";
import { multiplyAdds } from "./head.js";
import { compositeSource, foundTextures, headSource, marchSource, Program } from "./program.js";
import { checkMemory, deleteFramebuffer, framebufferOf, gpuBytes, isComplete, TILE } from "./textures.js";
import { uploadFloats, uploadGrid, uploadLattice } from "./textures.js";

const OPAQUE_DEPTH = Math.log(1000);

const LOST = "WebGL2: expected a context, got one that was lost";

const pictureOf = ({ width, height }) => `a picture of ${width}x${height}`;

const MEAN = `#version 300 es
precision highp float;
uniform highp sampler2D uSum;
uniform float uShare;
out vec4 picture;
void main() {
  picture = texelFetch(uSum, ivec2(gl_FragCoord.xy), 0) * uShare;
}
`;

export class Renderer {
  // Make a renderer of a scene. The scene's grid may still be null: its shaders are compiled meanwhile. Rejects with an Error
  // whose message says what is missing. If the context is lost, this waits until it is back.
  static async create(canvas, scene) {
    const renderer = new Renderer(canvas, scene);
    for (;;) {
      try {
        await renderer.warmUp();
        return renderer;
      } catch (error) {
        if (error.message !== LOST) throw error;
        const isBack = (go) => canvas.addEventListener("webglcontextrestored", go, { once: true });
        if (renderer.lost) await new Promise(isBack);
      }
    }
  }

  constructor(canvas, scene) {
    const settings = { alpha: true, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" };
    const gl = canvas.getContext("webgl2", settings);
    if (!gl) throw new Error("WebGL2: expected a browser that has it switched on, got none");
    Object.assign(this, { canvas, gl, scene, onrestored: null });
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault()); // otherwise it would not come back
    canvas.addEventListener("webglcontextrestored", () => {
      this.setUp();
      this.onrestored?.();
    });
    this.setUp();
  }

  get lost() {
    return this.gl.isContextLost();
  }

  get info() {
    const { manifest, head } = this.scene;
    return {
      renderer: this.name, gpuBytes: this.gpuBytes,
      n_fetches: manifest.n_fetches, n_channels: manifest.n_channels, multiplyAdds: multiplyAdds(head),
      resolution: manifest.resolution, contracted: manifest.contracted, quality: this.drawn ?? "high", lost: this.lost,
    };
  }

  setUp() {
    if (this.lost) return; // called again when the context is back
    const { gl } = this;
    const debug = gl.getExtension("WEBGL_debug_renderer_info");
    this.name = String(gl.getParameter(debug ? debug.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    this.sums = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
    this.sum = null;
    this.nSummed = 0;
    this.programs = new Map(); // by source
    this.layers = new Map(); // programs by layer, and whether they count fetches
    const { manifest } = this.scene, { source, weights, table } = headSource(this.scene);
    const diagonal = Math.hypot(...manifest.aabb[0].map((x, i) => manifest.aabb[1][i] - x));
    this.mostSteps = Math.floor((manifest.contracted ? Math.PI : diagonal) / manifest.step) + 3;
    this.program("colour");
    this.head = this.programOf(source);
    this.composite = this.programOf(compositeSource());
    this.mean = this.programOf(MEAN);
    this.tables = { uWeights: uploadFloats(gl, weights), uLayers: table, ...(manifest.contracted && { uLattice: uploadLattice(gl, manifest.step) }) };
    this.makeTile(manifest.n_channels);
    this.show(this.scene);
  }

  // Draw one pixel of the current scene, into a picture and to the canvas: drivers finish compiling a shader only when
  // something is drawn with it.
  async warmUp() {
    const c2w = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    const view = { c2w, fx: 1, fy: 1, cx: 0.5, cy: 0.5, width: 1, height: 1 };
    await this.done(); // does not block the page while shaders are compiled
    await this.read(view);
    this.paint(view, null, { upwards: true, premultiplied: true });
    await this.done();
  }

  show(scene) {
    const { gl } = this, { manifest } = scene, grid = scene.grid ?? NO_GRID;
    this.scene = scene;
    this.gpuBytes = gpuBytes(grid, manifest.n_channels);
    this.textures = uploadGrid(gl, grid, manifest.n_channels);
    this.constant = this.constantUniforms(grid);
    if (scene.grid) checkMemory(gl, "this scene");
  }

  // Show a finer scene from now on. If it does not fit into memory, shows the previous one again and throws an Error.
  replace(scene) {
    const before = this.scene;
    this.scene = scene;
    if (this.lost) return; // setUp shows it when the context is back
    this.forget();
    this.nSummed = 0;
    try {
      this.show(scene);
    } catch (error) {
      this.forget();
      this.show(before);
      throw error;
    }
  }

  forget() {
    const { gl } = this;
    for (const { texture } of Object.values(this.textures)) gl.deleteTexture(texture);
  }

  // Make the framebuffers between the passes of a tile: `found` for what the march has found in each pixel, and `colours` for
  // the head's colours, 2 x 2 pixels per texel. Throws an Error if the graphics card cannot draw to so many buffers at once,
  // or so many bits of a pixel in all of them.
  makeTile(nChannels) {
    const { gl } = this, n = foundTextures(nChannels), most = gl.getParameter(gl.MAX_DRAW_BUFFERS);
    // Here and in `read`, the browser tells no limit if the context has just been lost.
    if (most && n + 1 > most) throw new Error(`WebGL2: expected ${n + 1} draw buffers for ${nChannels} channels, got ${most}`);
    const made = (size, formats) => {
      const target = framebufferOf(gl, size, size, formats);
      if (isComplete(gl)) return target;
      throw new Error(`WebGL2: expected framebuffers for ${nChannels} channels, got an incomplete one`);
    };
    this.found = made(TILE, [...Array(n).fill(gl.RGBA32UI), gl.RG32UI]);
    this.colours = made(TILE / 2, [gl.RGBA32UI]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.passed = { uOpacity: this.found.textures[n], uColours: this.colours.textures[0] };
    for (let i = 0; i < n; i++) this.passed[`uFound${i}`] = this.found.textures[i];
  }

  constantUniforms(grid) {
    const { manifest } = this.scene, [low, high] = manifest.aabb, [logLow, logHigh] = manifest.density_range;
    return {
      ...this.textures, ...this.tables,
      uAabbMin: low, uCellsPerUnit: low.map((x, i) => manifest.resolution / (high[i] - x)),
      uStep: manifest.step, uMostLength: Math.fround((this.mostSteps - 1) * Math.fround(manifest.step)), uNear: manifest.near,
      uResolution: manifest.resolution, uLatticeSize: this.tables.uLattice?.n ?? 0,
      uMostTau: OPAQUE_DEPTH, uDensityCode: [logLow, (logHigh - logLow) / 255],
      uFeatureResolution: grid.featureResolution, uFeatureScale: grid.featureResolution / grid.resolution,
    };
  }

  program(layer, counting = false) {
    const key = `${layer} ${counting}`;
    if (!this.layers.has(key)) {
      const source = marchSource(this.scene, { layer, counting, mostSteps: this.mostSteps });
      this.layers.set(key, this.programOf(source));
    }
    return this.layers.get(key);
  }

  programOf(source) {
    if (!this.programs.has(source)) this.programs.set(source, new Program(this.gl, source));
    return this.programs.get(source);
  }

  // Return the feature lookups per ray and the base steps per sample of a view's quality. Lookups are limited as the bake
  // found. They are not limited where it found 0, which means that fewer lookups lose too much, nor in older assets, where
  // it did not look for limits.
  quality(view) {
    const { n_fetches: k, level_steps: steps, quality_fetches: limits } = this.scene.manifest;
    const [high, fast] = limits ?? [0, 0];
    const most = { exact: 0, high, fast }[view.quality ?? "high"];
    const fetches = Math.min(most || k, k || most); // 0 is no limit in both
    const uLevelSteps = Array.from({ length: 8 }, (_, level) => steps[level] ?? 1);
    return { uFetches: view.n_fetches ?? fetches, uLevelSteps, uLongestStep: Math.max(...uLevelSteps) };
  }

  // Draw a part of a view, [left, top, width, height], into a framebuffer; null is the canvas. `upwards`: the framebuffer's
  // first row is the picture's last. `counting`: draw the numbers of texture fetches. `summed`: add to what is there.
  paint(view, target, { upwards, premultiplied, counting = false, summed = false, part = [0, 0, view.width, view.height] }) {
    const { gl } = this, { manifest } = this.scene, layer = view.layer ?? "colour";
    const behind = view.background ?? manifest.background;
    const [dx, dy] = view.jitter ?? [0, 0];
    const values = {
      ...raysOf({ ...view, cx: view.cx - dx, cy: view.cy - dy }, manifest), ...this.quality(view),
      uRows: upwards ? [view.height, -1] : [0, 1], uPremultiplied: premultiplied,
      uBackground: behind === "transparent" ? [0, 0, 0, 0] : [...behind, 1],
    };
    const pass = (program, to, box, own) => {
      gl.bindFramebuffer(gl.FRAMEBUFFER, to);
      gl.viewport(...box);
      program.use({ ...values, ...own });
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    };
    const march = this.program(layer, counting), [left, top, width, height] = part;
    for (let y = top; y < top + height; y += TILE) {
      for (let x = left; x < left + width; x += TILE) {
        const box = [x, y, Math.min(TILE, left + width - x), Math.min(TILE, top + height - y)];
        if (layer === "colour" && !counting) {
          pass(march, this.found.framebuffer, [0, 0, box[2], box[3]], { ...this.constant, uTile: [x, y] });
          const half = [Math.ceil(box[2] / 2), Math.ceil(box[3] / 2)];
          pass(this.head, this.colours.framebuffer, [0, 0, ...half], { ...this.tables, ...this.passed, uTile: [x, y] });
          if (summed) gl.enable(gl.BLEND);
          pass(this.composite, target, box, { ...this.passed, uTile: [x, y] });
          gl.disable(gl.BLEND);
        } else {
          pass(march, target, box, { ...this.constant, uTile: [0, 0] });
        }
        gl.flush();
      }
    }
  }

  resize(width, height) {
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
  }

  draw(view) {
    const { gl } = this;
    if (this.lost) return;
    this.drawn = view.quality ?? "high"; // info tells it
    if (!view.accumulate || !this.sums || (view.layer ?? "colour") !== "colour") {
      this.nSummed = 0;
      this.paint({ ...view, jitter: [0, 0] }, null, { upwards: true, premultiplied: true });
      return;
    }
    if (this.sum?.width !== view.width || this.sum.height !== view.height) {
      if (this.sum) deleteFramebuffer(gl, this.sum);
      this.sum = framebufferOf(gl, view.width, view.height, [gl.RGBA16F]);
      this.nSummed = 0;
      if (!isComplete(gl)) {
        deleteFramebuffer(gl, this.sum);
        this.sum = this.sums = null;
        return this.draw(view);
      }
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.sum.framebuffer);
    if (this.nSummed === 0) gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.blendFunc(gl.ONE, gl.ONE);
    this.paint(view, this.sum.framebuffer, { upwards: true, premultiplied: true, summed: true });
    this.nSummed++;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, view.width, view.height);
    this.mean.use({ uSum: this.sum.textures[0], uShare: 1 / this.nSummed });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Return the bytes [4 n] of a part of a view, [left, top, width, height] in pixels: RGBA, the top row first, colours not
  // multiplied by alpha.
  async read(view, part = [0, 0, view.width, view.height], counting = false) {
    const { gl } = this;
    if (this.lost) throw new Error(LOST);
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (most && Math.max(view.width, view.height) > most) throw new Error(`size: expected at most ${most}x${most}, got ${view.width}x${view.height}`);
    const bytes = new Uint8Array(4 * part[2] * part[3]), buffer = gl.createBuffer();
    try {
      this.paintTo(buffer, bytes.length, view, part, counting);
      await this.done();
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
      gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, bytes);
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
      checkMemory(gl, pictureOf(view)); // some drivers take memory only when they draw
    } finally {
      gl.deleteBuffer(buffer);
    }
    return new Uint8ClampedArray(bytes.buffer);
  }

  // Draw a part of a view, and start copying its bytes to a pixel buffer.
  paintTo(buffer, length, view, part, counting) {
    const { gl } = this, target = framebufferOf(gl, view.width, view.height, [gl.RGBA8]);
    try {
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
      gl.bufferData(gl.PIXEL_PACK_BUFFER, length, gl.STREAM_READ);
      checkMemory(gl, pictureOf(view));
      this.paint(view, target.framebuffer, { upwards: false, premultiplied: false, counting, part });
      gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
      gl.readPixels(...part, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    } finally {
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      deleteFramebuffer(gl, target);
    }
  }

  // Wait until the GPU has finished all commands so far, without blocking the page.
  async done() {
    const { gl } = this, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    for (;;) {
      if (this.lost) throw new Error(LOST);
      const state = gl.clientWaitSync(fence, 0, 0);
      if (state === gl.WAIT_FAILED) throw new Error(LOST); // the fence was lost with a context that has come back
      if (state === gl.ALREADY_SIGNALED || state === gl.CONDITION_SATISFIED) break;
      await new Promise((resolve) => setTimeout(resolve, 2));
    }
    gl.deleteSync(fence);
  }

  async render(view) {
    return { width: view.width, height: view.height, rgba: await this.read({ quality: "exact", ...view }) };
  }

  // Return t along the ray of the pixel (x, y), in world units, where half of the ray's opacity is reached; null if nothing
  // is there.
  async depthAt(view, x, y) {
    const at = [Math.floor(x), Math.floor(y), 1, 1];
    const bytes = await this.read({ ...view, layer: "middle" }, at);
    const depth = new Float32Array(bytes.buffer)[0];
    return depth > 0 ? depth : null;
  }

  // Count the march's texture fetches for each pixel of a view, and the pixels for which the head runs: { fetches:
  // Uint32Array, nHits }.
  async count(view) {
    const words = new Uint32Array((await this.read({ ...view, background: "transparent" }, undefined, true)).buffer);
    return { fetches: words.map((word) => word & 0xffffff), nHits: words.reduce((sum, word) => sum + (word >>> 24), 0) };
  }
}
