// Starts a page: unpacks the viewer's script, which the page holds as text, compressed by zlib, and runs it. The page's
// content security policy names that script by its checksum.
//
// Programs find `vfr` at the page's load event, when that script may not have run yet. So `early` takes its place until
// then, and what programs ask of `early` waits.

import { bytesOf } from "./scene/text_bytes.js";

const CHANGED = "the page was cut short or changed on its way";
const NOT_RUN = "its script was changed on its way, or cannot run in this browser";

async function unpacked(element) {
  const bytes = element && bytesOf(element.textContent, Number(element.dataset.bytes));
  if (!bytes) throw new Error(CHANGED);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).text().catch(() => {
    throw new Error(CHANGED);
  });
}

async function begin() {
  document.getElementById("status").textContent = ""; // what stands there where no script runs
  const script = document.createElement("script");
  script.id = "script";
  script.textContent = await unpacked(document.getElementById("viewer"));
  document.body.append(script);
  if (window.vfr === early) throw new Error(NOT_RUN); // the policy allows no changed script
  Object.defineProperties(early, Object.getOwnPropertyDescriptors(window.vfr));
  return window.vfr.ready;
}

const early = {
  info: null,
  async render(view) {
    const asked = structuredClone(view); // as in api.js
    await early.ready;
    return early.render(asked);
  },
};
window.vfr = early;
early.ready = begin();
early.ready.catch(({ message }) => {
  const status = document.getElementById("status");
  if (status.textContent) return; // the viewer has reported it already
  document.body.classList.add("failed");
  const advice = message === CHANGED ? "Load it again, or ask for it anew" : "Open this page in a current Chrome, Edge, Firefox or Safari";
  status.textContent = `This scene cannot be shown here: ${message}. ${advice}.`;
});
