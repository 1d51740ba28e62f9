// Runs a SceneReader in a worker. Messages { call, args, id } call its methods and are answered by { id, result } or
// { id, error, isWhole, isMemory }, where isMemory tells that the device has refused memory. While a part is
// read, messages { progress } tell the bytes of each section. The worker's first message is { isReady: true }.

import { SceneReader, refusesMemory } from "./scene/scene_reader.js";

let reader = null;

const CALLS = {
  open: (manifest, grids) => {
    reader = new SceneReader(manifest, grids, async () => {});
  },
  read: (file) => reader.read(file, (progress) => postMessage({ progress })),
  grid: () => reader.grid(),
};

self.onmessage = async ({ data: { call, args, id } }) => {
  try {
    const result = await CALLS[call](...args);
    const arrays = Object.values(result ?? {}).filter(ArrayBuffer.isView);
    postMessage({ id, result }, arrays.map((array) => array.buffer));
  } catch (error) {
    postMessage({ id, error: error.message, isWhole: reader?.isWhole ?? false, isMemory: refusesMemory(error) });
  }
};
postMessage({ isReady: true });
