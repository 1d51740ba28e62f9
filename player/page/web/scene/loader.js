// Finds the files of a scene, in the page or beside it, has them decoded in workers, and yields what is known so far:
//
//     for await (const scene of loadScene(onProgress)) ...
//
// The first scene has no grid yet. Others follow after the first part and, if the files are beside the page, after each
// later part; otherwise only after the last. A scene is
//
//     { manifest, cameras, head, grid, n_parts, problem }
//
// - manifest: the asset's manifest (docs/format.md), without its provenance;
// - cameras: [{ name, width, height, fx, fy, cx, cy, c2w: [16], row-major, OpenGL axes, world frame }, ...];
// - head: { sh_degree, in_8_bits, activation, n_channels, spatial: [layer, ...], to_sh: layer, harmonics: layer,
//   bottleneck: layer, from_sh: layer, directional: [layer, ...], output: layer, roundings: [{ scale, zero }, ...],
//   of_encoded: { scale, zero } or null, monomials: [[parent, axis], ...] }, as player/head/graph.py names them. A layer is
//   { n_in, n_out, weight, bias, scale }: weight [n_in * n_out] row-major, bias [n_out], scale [n_out] or null. All are
//   Float32Array, but in 8 bits weight is an Int8Array and bias an Int32Array. A monomial is the product of an earlier one
//   (its place in the list, -1 for 1) and the axis 0 to 2 of the direction;
// - grid: the arrays of grid.js, or null;
// - n_parts: how many parts have been read; problem: a sentence about a part that could not be read, or null.
//
// onProgress({ done, total }) is told the progress in bytes: half of the total is for loading and half for decoding.
//
// If the browser or the device cannot decode a scene, the Error that loadScene throws has `isWhole`: true, which says that
// the data are not to blame, or is one that `refusesMemory` knows. If no scene is found beside the page, it has `isAlone`: true.

import { SceneReader, checkedFile, checkSum } from "./scene_reader.js";

const MANIFEST = "manifest.json";
const GRIDS = ["densities", "features"];

export async function* loadScene(onProgress) {
  const isFile = document.querySelector("script[data-file]") !== null;
  const manifest = await manifestOf(isFile).catch((error) => {
    throw Object.assign(error, { isAlone: !isFile });
  });
  const nParts = manifest.parts.length;
  const total = manifest.parts.reduce((sum, part) => sum + manifest.files[part.file].bytes, 0);
  const done = { there: isFile ? total : 0, decoded: 0 };
  const end = new AbortController(), { signal } = end;
  const tell = () => signal.aborted || onProgress({ done: done.there + done.decoded, total: 2 * total });
  const get = async (name) => (isFile ? { text: textInPage(name) } : { bytes: await fetched(name, manifest.files[name], (n) => {
    if (name.startsWith("part_")) done.there += n;
    tell();
  }, signal) });
  const small = async (name) => checkedFile(name, await get(name), manifest.files[name]);
  const cameras = JSON.parse(new TextDecoder().decode(await small("cameras.json")));
  const head = headOf(JSON.parse(new TextDecoder().decode(await small("head.json"))), await small("head.bin"));
  const readers = await startReaders(manifest).catch((error) => {
    throw Object.assign(error, { isWhole: true });
  });
  const read = (file) => readers.read(file, (n) => {
    done.decoded += n;
    tell();
  });
  // Ask the readers to decode a part and, if it is shown, to arrange the grid. Resolves to the promises of both as soon as
  // that is asked for; then the next part may be asked for.
  const begin = async (part, isShown) => {
    const file = await get(manifest.parts[part].file);
    const asked = { read: read(file), grid: isShown ? readers.grid() : null };
    for (const promise of [asked.read, asked.grid]) promise?.catch(() => {}); // errors are reported when these are awaited
    return asked;
  };
  let scene = { manifest, cameras, head, grid: null, n_parts: 0, problem: null };
  try {
    const begun = [];
    for (let part = 0; part < nParts; part++) {
      // The data inside a page is there at once: only the first part and the whole scene are shown.
      const isShown = part === 0 || part + 1 === nParts || !isFile;
      begun.push(part ? begun[part - 1].then(() => begin(part, isShown)) : begin(part, isShown));
      begun[part].catch(() => {});
    }
    yield scene;
    for (let part = 0; part < nParts && scene.problem === null; part++) {
      try {
        const asked = await begun[part];
        await asked.read;
        if (!asked.grid) continue;
        scene = { ...scene, grid: await asked.grid, n_parts: part + 1 };
      } catch (error) {
        if (part === 0) throw error;
        const problem = `${error.message}: shown as the first ${part} of ${nParts} parts have it`;
        scene = { ...scene, ...(readers.areWhole && { grid: await readers.grid(), n_parts: part }), problem };
      }
      yield scene;
    }
  } finally {
    end.abort();
    readers.close();
  }
}

// Return the text of a file of the data in the page, and remove it from there, except the manifest.
function textInPage(name) {
  const element = document.querySelector(`script[data-file="${name}"]`);
  if (!element) throw new Error(`${name}: expected it in the page, got none: the page was cut short`);
  const text = element.textContent;
  if (name !== MANIFEST) element.remove();
  return text;
}

// Fetch a file beside the page, as bytes; `onBytes` is called with the number of bytes each time some arrive. The browser
// asks the server whether a copy that it has kept is still the file: the scene may have been exported again.
async function fetched(name, entry, onBytes = () => {}, signal) {
  const response = await fetch(name, { cache: "no-cache", signal }).catch(() => ({ status: "no answer" }));
  if (!response.ok) throw new Error(`${name}: expected it beside the page, got ${response.status}`);
  const most = entry?.bytes ?? 1 << 24;
  const data = new Uint8Array(most);
  let length = 0;
  const reader = response.body.getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return data.subarray(0, length);
    if (length + value.length > most) throw new Error(`${name}: expected at most ${most} bytes, got more`);
    data.set(value, length);
    length += value.length;
    onBytes(value.length);
  }
}

async function manifestOf(isFile) {
  const text = isFile ? textInPage(MANIFEST) : new TextDecoder().decode(await fetched(MANIFEST));
  let manifest;
  try {
    manifest = JSON.parse(text);
  } catch {
    throw new Error(`${MANIFEST}: expected JSON: the page was cut short or changed`);
  }
  const { sha256 } = document.querySelector("[data-sha256]")?.dataset ?? {};
  if (isFile) await checkSum(MANIFEST, new TextEncoder().encode(text), sha256);
  return manifest;
}

const TYPES = { float32: Float32Array, int8: Int8Array, int32: Int32Array };

// Return the head's description with its arrays in place, taken from `data`, the bytes of head.bin.
function headOf(description, data) {
  const numbers = data.slice().buffer;
  const array = (entry, length) => entry && new TYPES[entry.type](numbers, entry.first, length);
  const layer = ({ n_in, n_out, weight, bias, scale }) => ({
    n_in, n_out, weight: array(weight, n_in * n_out), bias: array(bias, n_out), scale: array(scale, n_out),
  });
  const head = { ...description };
  for (const name of ["to_sh", "harmonics", "bottleneck", "from_sh", "output"]) head[name] = layer(head[name]);
  for (const name of ["spatial", "directional"]) head[name] = head[name].map(layer);
  return head;
}

// SceneReaders that each read some of the grids of one scene.
class Readers {
  constructor(readers) {
    this.readers = readers;
  }

  get areWhole() {
    return this.readers.every((reader) => reader.isWhole);
  }

  async read(file, onProgress) {
    const done = await Promise.allSettled(this.readers.map((reader) => reader.read(file, onProgress)));
    for (const { reason } of done) if (reason) throw reason;
  }

  async grid() {
    return Object.assign({}, ...await Promise.all(this.readers.map((reader) => reader.grid())));
  }

  close() {
    for (const reader of this.readers) reader.close();
  }
}

// Start a worker for each grid; where there can be no workers, one reader in the page itself.
async function startReaders(manifest) {
  const workers = [];
  try {
    for (const grid of GRIDS) workers.push(new WorkerReader(manifest, [grid]));
    await Promise.all(workers.map((worker) => worker.isReady));
    return new Readers(workers);
  } catch (error) {
    for (const worker of workers) worker.close();
    if (error instanceof SceneError) throw error;
    const pause = () => new Promise((resolve) => { setTimeout(resolve); });
    return new Readers([Object.assign(new SceneReader(manifest, GRIDS, pause), { close() {} })]);
  }
}

// An error of the scene, for which the worker is not to blame.
class SceneError extends Error {}

// A SceneReader in a worker.
class WorkerReader {
  constructor(manifest, grids) {
    const script = document.getElementById("script").textContent; // the page's own, which begins with worker.js there
    const address = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
    this.worker = new Worker(address);
    this.waiting = new Map();
    this.asked = 0;
    this.isWhole = true;
    this.onProgress = () => {};
    this.isReady = new Promise((resolve, reject) => {
      this.worker.onerror = (event) => {
        event.preventDefault();
        const error = new Error(event.message || "the worker does not start");
        reject(error);
        for (const { reject: refuse } of this.waiting.values()) refuse(error);
      };
      this.worker.onmessage = ({ data }) => {
        if (data.isReady) resolve();
        else if (data.progress !== undefined) this.onProgress(data.progress);
        else this.take(data);
      };
    }).finally(() => URL.revokeObjectURL(address)).then(() => this.ask("open", manifest, grids));
  }

  take({ id, result, error, isWhole, isMemory }) {
    const { resolve, reject } = this.waiting.get(id);
    this.waiting.delete(id);
    if (error === undefined) {
      resolve(result);
    } else {
      this.isWhole = isWhole;
      reject(Object.assign(new SceneError(error), { isWhole: isMemory }));
    }
  }

  ask(call, ...args) {
    return new Promise((resolve, reject) => {
      this.waiting.set(++this.asked, { resolve, reject });
      this.worker.postMessage({ call, args, id: this.asked });
    });
  }

  read(file, onProgress) {
    this.onProgress = onProgress;
    return this.ask("read", file);
  }

  grid() {
    return this.ask("grid");
  }

  close() {
    this.worker.terminate();
  }
}
