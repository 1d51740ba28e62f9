// The bar below the picture: its buttons and their keys, the help card, saving the picture, full screen, and the line of
// text about the state of things.

import { Views } from "./views.js";

const LAYERS = ["colour", "depth", "normals", "opacity"];
const element = (id) => document.getElementById(id);

// Return what a key is called in `keys` below. On a keyboard of another script, it is the Latin letter or the bracket of
// the key at the same place.
function nameOf({ key, code }) {
  const name = key < "\x7f" ? key : { BracketLeft: "[", BracketRight: "]" }[code] ?? code.replace("Key", "");
  return name.length > 1 ? name : name.toLowerCase();
}

export class Panel {
  // Set up what is shown before there is a scene.
  constructor() {
    element("title").textContent = document.title;
    element("poster").alt = `Preview of ${document.title}`;
    const card = element("card");
    card.addEventListener("click", (event) => event.target === card && card.close()); // beside the card
    element("close").addEventListener("click", () => card.close());
  }

  // Follow the options of the page's address.
  follow({ noui, background }) {
    const isClear = background === "transparent", { classList } = document.body;
    classList.toggle("plain", Boolean(noui));
    classList.toggle("clear", isClear);
    // Browsers make a frame opaque whose colour scheme is not that of the page around it, which mostly is the light one.
    document.documentElement.style.colorScheme = isClear ? "light" : "";
  }

  // Show a line of text below the picture; "" removes it. After `fail`, its text stays.
  say(text) {
    if (!document.body.classList.contains("failed")) element("status").textContent = text;
  }

  // Show how much of the scene is there, 0..1; 1 removes the progress bar.
  progress(share) {
    element("progress").value = share;
    element("progress").hidden = share >= 1;
  }

  // Report that the scene cannot be shown: the poster stays, and `text` says what to do.
  fail(text) {
    this.progress(1);
    this.say(text);
    document.body.classList.add("failed");
  }

  // Connect the buttons with a viewer.
  connect(viewer, controls, cameras) {
    this.viewer = viewer;
    const layer = element("layer");
    const views = new Views(viewer, cameras, { select: element("views"), before: element("before"), after: element("after") });
    const press = (id, on) => element(id).setAttribute("aria-pressed", on);
    const show = (index) => {
      layer.selectedIndex = index;
      viewer.set({ layer: LAYERS[index] });
    };
    const actions = {
      home: () => viewer.flyHome(),
      turn: () => {
        const on = !viewer.turning;
        viewer.touch();
        viewer.turn(on);
      },
      fly: () => press("fly", (controls.flies = !controls.flies)),
      save: () => this.save().catch((error) => this.say(error.message)),
      full: () => this.fullScreen(),
      help: () => {
        const card = element("card");
        card.showModal();
        card.scrollTop = 0; // the browser scrolls to the button at its end, which has the focus
      },
    };
    const keys = {
      Home: actions.home, " ": actions.turn, g: actions.fly, p: actions.save, f: actions.full, "?": actions.help,
      "[": () => views.go(-1), "]": () => views.go(1),
      c: () => viewer.turnAround(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2),
    };
    LAYERS.forEach((_, index) => (keys[index + 1] = () => show(index)));
    for (const id in actions) element(id).addEventListener("click", actions[id]);
    layer.addEventListener("change", () => show(layer.selectedIndex));
    element("full").hidden = !document.fullscreenEnabled;
    viewer.onturn = (on) => press("turn", on);
    press("turn", viewer.turning);
    window.addEventListener("keydown", (event) => {
      const action = keys[nameOf(event)];
      const taken = event.target.closest?.(`select, input, dialog[open]${event.key === " " ? ", button" : ""}`);
      const bracket = event.altKey && "[]".includes(event.key); // a bracket typed with AltGr or Option
      if (!action || taken || event.repeat || event.metaKey) return;
      if (!bracket && (event.ctrlKey || event.altKey)) return; // the browser handles it
      event.preventDefault();
      action();
    });
    element("bar").inert = false;
  }

  fullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else if (document.fullscreenEnabled) document.documentElement.requestFullscreen().catch(() => {});
  }

  // Save what the window shows, every pixel of it.
  async save() {
    const { width, height, rgba } = await this.viewer.picture();
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    canvas.getContext("2d").putImageData(new ImageData(rgba, width, height), 0, 0);
    canvas.toBlob((blob) => {
      const link = Object.assign(document.createElement("a"), {
        href: URL.createObjectURL(blob), download: `${document.title.replace(/[^\p{L}\p{N} ._-]/gu, "_")}.png`,
      });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    }, "image/png");
  }
}
