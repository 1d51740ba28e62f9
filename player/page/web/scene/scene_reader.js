// Decodes a scene, in workers or in the page: checks the files of the data against the manifest, decodes the parts to
// densities and features, and arranges these as the arrays of grid.js.

import { arrangeDensities, arrangeFeatures } from "./grid.js";
import { PartsReader } from "./parts.js";
import { bytesOf } from "./text_bytes.js";

// Return the bytes of a file of the data, given as { text } if the page holds it, or as { bytes } if a server sent it.
// Rejects with an Error if the file is not the one that the manifest's `entry` { bytes, sha256 } describes.
export async function checkedFile(name, { text, bytes }, entry) {
  const data = bytes ?? bytesOf(text, entry.bytes);
  if (!data || data.length !== entry.bytes) {
    const got = data ? `${data.length}` : `${text.length} characters for them`;
    throw new Error(`${name}: expected ${entry.bytes} bytes, got ${got}: it was cut short or changed on its way`);
  }
  await checkSum(name, data, entry.sha256);
  return data;
}

// Reject with an Error if the bytes of a file have another SHA-256. Browsers compute none on pages sent without encryption.
export async function checkSum(name, data, sha256) {
  const digest = await globalThis.crypto?.subtle?.digest("SHA-256", data);
  if (!digest) return;
  const found = Array.from(new Uint8Array(digest), (byte) => byte.toString(16).padStart(2, "0")).join("");
  if (found !== sha256) throw new Error(`${name}: sha256: expected another one: it was changed on its way`);
}

// Return whether an error says that the browser refuses memory. Damaged data, too, can end in a RangeError.
export const refusesMemory = (error) => error instanceof RangeError && /alloc|memory/i.test(error.message);

export class SceneReader {
  // `grids`: which of "densities" and "features" to read; `pause`: an async function that is awaited now and then, so that
  // other work can be done in between.
  constructor(manifest, grids, pause) {
    if (!globalThis.DecompressionStream) throw new Error("expected a browser with DecompressionStream, got an older one");
    this.manifest = manifest;
    this.pause = pause;
    this.parts = new PartsReader(manifest, grids);
    this.last = Promise.resolve(); // the call that was made last
    this.isWhole = true; // false while a part is decoded, and for good if that fails
  }

  // Read the next part, { text } or { bytes }; `onProgress` is called with numbers of bytes. If this rejects with an Error, the
  // scene is still that of the parts before, unless `isWhole` has become false. Calls may be made before the last one is done.
  read(file, onProgress) {
    return this.next(async () => {
      const { file: name } = this.manifest.parts[this.parts.nRead];
      const data = await checkedFile(name, file, this.manifest.files[name]);
      this.isWhole = false;
      await this.parts.read(data, onProgress, this.pause);
      this.isWhole = true;
    });
  }

  // Return the arrays of grid.js for the grids, as far as they have been read.
  grid() {
    return this.next(() => {
      const { densities, features } = this.parts.values();
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
