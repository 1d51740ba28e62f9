// The interface for programs: `window.vfr`, which is there at the page's load event.
//
//     await vfr.ready;  vfr.info;  await vfr.render({ c2w, fx, fy, cx, cy, width, height, quality, background })

import { column, cross, dot } from "./viewer/pose.js";

const SIZES = ["fx", "fy", "cx", "cy", "width", "height"];
const QUALITIES = ["exact", "high", "fast"];

// Install `window.vfr`; `renderer` is a promise of the Renderer that shows the whole scene.
export function installApi(renderer) {
  let found = null, last = Promise.resolve(); // the end of the picture that was asked for last
  const ready = renderer.then((made) => {
    found = made;
  });
  ready.catch(() => {}); // reported by whoever awaits it, and by the page
  globalThis.vfr = {
    ready,
    get info() {
      return found?.info ?? null;
    },
    async render(view) {
      const asked = structuredClone(view); // as it is now: a script may move it on before its turn comes
      // One picture after another: all at once could take more memory than there is.
      const picture = last.then(() => ready).then(() => found.render(checked(asked)));
      last = picture.then(() => {}, () => {});
      return picture;
    },
  };
}

// Return the view with its quality, "exact" by default. Throws a TypeError that names what is wrong with the view.
function checked(view) {
  const wrong = (what, expected, got) => new TypeError(`vfr.render: ${what}: expected ${expected}, got ${JSON.stringify(got)}`);
  const numbers = (some, n, low, high) => some?.length === n && [...some].every((x) => Number.isFinite(x) && x >= low && x <= high);
  const c2w = view?.c2w;
  if (!numbers(c2w, 16, -1e12, 1e12)) throw wrong("c2w", "16 numbers", c2w);
  const axes = [0, 1, 2].map((i) => column(c2w, i)); // checked as check_pose in player/cameras/camera.py does
  const isRigid = axes.every((a, i) => axes.every((b, j) => Math.abs(dot(a, b) - (i === j)) <= 1e-3))
    && dot(axes[0], cross(axes[1], axes[2])) > 0 && [0, 0, 0, 1].every((x, i) => Math.abs(c2w[12 + i] - x) <= 1e-6);
  if (!isRigid) throw wrong("c2w", "a rotation and a translation, row by row", c2w);
  for (const name of SIZES) if (!Number.isFinite(view[name])) throw wrong(name, "a number", view[name]);
  for (const name of ["fx", "fy"]) if (view[name] <= 0) throw wrong(name, "a number above 0", view[name]);
  for (const name of ["width", "height"]) if (!(Number.isInteger(view[name]) && view[name] > 0)) throw wrong(name, "a whole number above 0", view[name]);
  const { quality = "exact", background } = view;
  if (!QUALITIES.includes(quality)) throw wrong("quality", QUALITIES.join(", "), quality);
  if (background !== undefined && background !== "transparent" && !numbers(background, 3, 0, 1)) throw wrong("background", '[r, g, b] in 0..1 or "transparent"', background);
  return { ...view, quality };
}
