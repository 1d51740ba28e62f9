// The page's entry point: loads and draws the scene, and hands it to the viewer and to programs.

import { installApi } from "./api.js";
import { Controls } from "./viewer/controls.js";
import { optionsOf } from "./hash.js";
import { loadScene } from "./scene/loader.js";
import { Panel } from "./viewer/panel.js";
import { Renderer } from "./drawing/renderer.js";
import { refusesMemory } from "./scene/scene_reader.js";
import { Viewer } from "./viewer/viewer.js";

const INSTEAD = "Open this page in a current Chrome, Edge, Firefox or Safari, with hardware acceleration switched on "
  + "in its settings, or on a device with more memory, or ask for the scene baked with --preset phone.";
const ANEW = "What arrived is not whole: load the page again, or ask for it anew.";
const RESET = "The graphics card was reset. If the picture does not come back by itself, "
  + "load the page again.";

// Show the scene; resolve to the renderer when all of the scene is there, and reject if it cannot all be shown.
async function show() {
  const canvas = document.getElementById("canvas"), panel = new Panel();
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  let renderer = null, viewer = null, problem = null, advice = ANEW;
  let said = "Loading…"; // the text below the picture, unless the graphics card was reset
  panel.say(said);
  canvas.addEventListener("webglcontextlost", () => panel.say(RESET));
  let options;
  const follow = () => {
    options = optionsOf(location.hash);
    panel.follow(options);
    viewer?.flyToView(options.view);
    viewer?.follow(options);
  };
  try {
    follow();
    addEventListener("hashchange", follow);
    for await (const scene of loadScene(({ done, total }) => panel.progress(done / total))) {
      problem = scene.problem;
      advice = INSTEAD;
      if (!renderer) {
        // its shaders are compiled while the scene is being unpacked
        renderer = await Renderer.create(canvas, scene);
        renderer.onrestored = () => {
          viewer?.restored();
          panel.say(said);
        };
        panel.say(said); // replaces RESET if the context was lost meanwhile and is back
      }
      if (scene.grid) renderer.replace(scene);
      advice = ANEW;
      if (!scene.grid) continue;
      if (viewer) {
        viewer.refresh();
        continue;
      }
      viewer = new Viewer(canvas, renderer, scene.cameras, options, calm, scene.manifest.background);
      panel.connect(viewer, new Controls(viewer), scene.cameras);
    }
  } catch (error) {
    if (error.isWhole || refusesMemory(error)) advice = INSTEAD;
    if (error.isAlone) advice = document.getElementById("stage").dataset.advice || ANEW;
    if (viewer) problem = `This scene cannot be shown whole here: ${error.message}. ${advice}`;
    else panel.fail(`This scene cannot be shown here: ${error.message}. ${advice}`);
    throw error;
  } finally {
    said = problem ?? "";
    panel.progress(1);
    if (!renderer?.lost) panel.say(said);
    viewer?.uncover();
  }
  if (problem) throw new Error(problem); // the page goes on showing what it has
  return renderer;
}

installApi(show());
