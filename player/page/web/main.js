// Where the page begins: the scene is loaded and drawn, and handed to the viewer and to programs.

import { installApi } from "./api.js";
import { Controls } from "./controls.js";
import { optionsOf } from "./hash.js";
import { loadScene } from "./loader.js";
import { Panel } from "./panel.js";
import { Renderer } from "./renderer.js";
import { Viewer } from "./viewer.js";

const INSTEAD = "Open this page in a current Chrome, Edge, Firefox or Safari, with hardware acceleration switched on "
  + "in its settings, or on a device with more graphics memory.";
const ANEW = "What arrived is not whole: load the page again, or ask for it anew.";

// Shows the scene; the renderer, when all of it is there.
async function show() {
  const options = optionsOf(location.hash), canvas = document.getElementById("canvas");
  const panel = new Panel(options);
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  let renderer = null, viewer = null, problem = null, advice = ANEW;
  panel.say("Loading…");
  try {
    for await (const scene of loadScene(({ done, total }) => panel.progress(done / total))) {
      problem = scene.problem;
      advice = INSTEAD;
      renderer ??= await Renderer.create(canvas, scene); // its shaders are compiled while the scene is unpacked
      if (scene.grid) renderer.replace(scene);
      advice = ANEW;
      if (!scene.grid) continue;
      if (viewer) {
        viewer.refresh();
        continue;
      }
      viewer = new Viewer(canvas, renderer, scene.cameras, options, calm, scene.manifest.background);
      panel.connect(viewer, new Controls(viewer), scene.cameras);
      renderer.onlost = () => {
        viewer.loseContext(true);
        panel.say("The graphics card was reset. If the picture does not come back by itself, load the page again.");
      };
      renderer.onrestored = () => {
        viewer.loseContext(false);
        panel.say("");
      };
    }
  } catch (error) {
    if (viewer) panel.say(error.message);
    else panel.fail(`This scene cannot be shown here: ${error.message}. ${advice}`);
    throw error;
  }
  panel.progress(1);
  panel.say(problem ?? "");
  viewer.uncover();
  return renderer;
}

installApi(show());
