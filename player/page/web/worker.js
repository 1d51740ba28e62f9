// Runs in a worker: a SceneReader that is asked by messages { call, args, id } and answers with { id, result } or
// { id, error, isWhole }, and while it reads with { progress }.

import { SceneReader } from "./scene_reader.js";

let reader = null;

const CALLS = {
  open: (manifest) => {
    reader = new SceneReader(manifest, async () => {});
  },
  read: (file) => reader.read(file, (progress) => postMessage({ progress })),
  values: (isLast) => reader.values(isLast),
};

self.onmessage = async ({ data: { call, args, id } }) => {
  try {
    const result = await CALLS[call](...args);
    const transfer = result ? [result.densities.values.buffer, result.features.values.buffer] : [];
    postMessage({ id, result }, transfer);
  } catch (error) {
    postMessage({ id, error: error.message, isWhole: reader?.isWhole ?? false });
  }
};
postMessage({ isReady: true });
