// What decodes a scene, in workers or in the page: files of the data are compared with the manifest, parts become
// densities and features, and these the arrays of grid.js.

import { arrangeDensities, arrangeFeatures } from "./grid.js";
import { PartsReader } from "./parts.js";
import { bytesOf } from "./text_bytes.js";

// The bytes of a file of the data that is { text }, as the page has it, or { bytes }, as a server does. Rejects with an
// Error if it is not the one of the manifest's `entry` { bytes, sha256 }.
export async function checkedFile(name, { text, bytes }, entry) {
  const data = bytes ?? bytesOf(text, entry.bytes);
  if (!data || data.length !== entry.bytes) {
    const got = data ? `${data.length}` : `${text.length} characters for them`;
    throw new Error(`${name}: expected ${entry.bytes} bytes, got ${got}: it was cut short or changed on its way`);
  }
  const digest = await globalThis.crypto?.subtle?.digest("SHA-256", data);
  if (digest) {
    const found = Array.from(new Uint8Array(digest), (byte) => byte.toString(16).padStart(2, "0")).join("");
    if (found !== entry.sha256) throw new Error(`${name}: sha256: expected another one: it was changed on its way`);
  }
  return data;
}

export class SceneReader {
  // `grids`: which of "densities" and "features" it is to read; `pause` is awaited now and then: where other work is to
  // be done between.
  constructor(manifest, grids, pause) {
    if (!globalThis.DecompressionStream) throw new Error("expected a browser with DecompressionStream, got an older one");
    this.manifest = manifest;
    this.pause = pause;
    this.parts = new PartsReader(manifest, grids);
    this.last = Promise.resolve(); // what was asked for last
    this.isWhole = true; // whether a part was not begun to be read that is broken
  }

  // Reads the next part, { text } or { bytes }; `onProgress` is told of bytes. Rejects with an Error: the scene is then
  // that of the parts before, unless `isWhole` has become false. Calls may be made before the last one is done.
  read(file, onProgress) {
    return this.next(async () => {
      const { file: name } = this.manifest.parts[this.parts.nRead];
      const data = await checkedFile(name, file, this.manifest.files[name]);
      this.isWhole = false;
      await this.parts.read(data, onProgress, this.pause);
      this.isWhole = true;
    });
  }

  // The arrays of its grids, as far as they are read.
  grid(isLast) {
    return this.next(() => {
      const { densities, features } = this.parts.values(isLast);
      return {
        ...(densities && arrangeDensities(this.manifest, densities)),
        ...(features && arrangeFeatures(this.manifest, features)),
      };
    });
  }

  next(call) {
    const found = this.last.then(call);
    this.last = found.catch(() => {});
    return found;
  }
}
