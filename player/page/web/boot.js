// Begins the page in one file: unpacks the viewer's script, which the page has as zlib's bytes in text, and runs it. The
// page's policy names that script by its checksum.
//
// Programs find `vfr` at the page's load event, when that script may not run yet: what they ask of it waits.

import { bytesOf } from "./text_bytes.js";

const CHANGED = "the page was cut short or changed on its way";

async function unpacked(element) {
  const bytes = bytesOf(element.textContent, Number(element.dataset.bytes));
  if (!bytes) throw new Error(CHANGED);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).text().catch(() => {
    throw new Error(CHANGED);
  });
}

async function begin() {
  const script = document.createElement("script");
  script.id = "script";
  script.textContent = await unpacked(document.getElementById("viewer"));
  document.body.append(script);
  if (window.vfr === early) throw new Error(CHANGED); // the policy lets no other script run
  Object.defineProperties(early, Object.getOwnPropertyDescriptors(window.vfr));
  return window.vfr.ready;
}

const early = { info: null, render: (view) => early.ready.then(() => early.render(view)) };
window.vfr = early;
early.ready = begin();
early.ready.catch(({ message }) => {
  const status = document.getElementById("status");
  if (status.textContent) return; // the viewer has said it
  document.body.classList.add("failed");
  status.textContent = `This scene cannot be shown here: ${message}. Open this page in a current Chrome, Edge, Firefox or Safari.`;
});
