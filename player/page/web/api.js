// The interface for programs: `window.vfr`, which is there at the page's load event.
//
//     await vfr.ready;  vfr.info;  await vfr.render({ c2w, fx, fy, cx, cy, width, height, quality, background })

const SIZES = ["fx", "fy", "cx", "cy", "width", "height"];
const QUALITIES = ["exact", "high", "fast"];

// Install `window.vfr`; `renderer` is a promise of the Renderer that shows the whole scene.
export function installApi(renderer) {
  let found = null;
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
      await ready;
      return found.render(checked(view));
    },
  };
}

// Return the view with its quality, "exact" by default. Throws a TypeError that names what is wrong with the view.
function checked(view) {
  const wrong = (what, expected, got) => new TypeError(`vfr.render: ${what}: expected ${expected}, got ${JSON.stringify(got)}`);
  const numbers = (some, n) => some?.length === n && [...some].every(Number.isFinite);
  if (!numbers(view?.c2w, 16)) throw wrong("c2w", "16 numbers", view?.c2w);
  for (const name of SIZES) if (!Number.isFinite(view[name])) throw wrong(name, "a number", view[name]);
  for (const name of ["fx", "fy"]) if (view[name] <= 0) throw wrong(name, "a number above 0", view[name]);
  for (const name of ["width", "height"]) if (!(Number.isInteger(view[name]) && view[name] > 0)) throw wrong(name, "a whole number above 0", view[name]);
  const { quality = "exact", background } = view;
  if (!QUALITIES.includes(quality)) throw wrong("quality", QUALITIES.join(", "), quality);
  if (background !== undefined && background !== "transparent" && !numbers(background, 3)) throw wrong("background", '[r, g, b] or "transparent"', background);
  return { ...view, quality };
}
