// A renderer that draws its background and, where something is hit, a disc: for tests of the page around it.

export class Renderer {
  static async create(canvas, scene) {
    return new Renderer(canvas, scene);
  }

  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2");
    if (!gl) throw new Error("expected WebGL 2, got none");
    Object.assign(this, { canvas, gl, scene });
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.onrestored?.());
  }

  get lost() {
    return this.gl.isContextLost();
  }

  resize(width, height) {
    Object.assign(this.canvas, { width, height });
  }

  replace(scene) {
    this.scene = scene;
  }

  draw({ width, height, background }) {
    const { gl } = this, [red, green, blue, alpha] = background === "transparent" ? [0, 0, 0, 0] : [...background, 1];
    gl.viewport(0, 0, width, height);
    gl.clearColor(red, green, blue, alpha);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(width / 4, height / 4, width / 2, height / 2);
    gl.clearColor(0.2, 0.5, 0.7, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.disable(gl.SCISSOR_TEST);
  }

  async render({ width, height }) {
    return { width, height, rgba: new Uint8ClampedArray(4 * width * height).fill(200) };
  }

  async depthAt(view, x, y) {
    return Math.abs(x - view.width / 2) < view.width / 4 && Math.abs(y - view.height / 2) < view.height / 4 ? 3 : null;
  }
}
