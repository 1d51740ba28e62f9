// Reads the options in the address of the page: #view=12&quality=exact&noui&turn&background=white

const COLOURS = new Map([["white", [1, 1, 1]], ["black", [0, 0, 0]], ["transparent", "transparent"]]);

// Return the options in the text behind `#`. An option that is not there, or cannot be read, is undefined.
//
// view: number of a training view, from 0; quality: "exact", "high" or "fast"; noui: true to show the picture alone; turn:
// whether the scene turns until it is touched, and, if true, again when nobody has touched it for some time; background:
// white, black, transparent or R,G,B in 0..255, returned as [r, g, b] in 0..1 or "transparent".
export function optionsOf(hash) {
  const given = new URLSearchParams(hash.replace(/^#/, ""));
  const options = {};
  const view = given.get("view"), quality = given.get("quality"), background = given.get("background");
  const switched = (name) => (given.has(name) ? !/^(0|off|false|no)$/.test(given.get(name)) : undefined);
  if (/^\d{1,9}$/.test(view ?? "")) options.view = Number(view);
  if (["exact", "high", "fast"].includes(quality)) options.quality = quality;
  options.noui = switched("noui");
  options.turn = switched("turn");
  const levels = (background ?? "").split(",").map((text) => (/^\d{1,3}$/.test(text) ? Number(text) / 255 : 2));
  if (COLOURS.has(background)) options.background = COLOURS.get(background);
  else if (levels.length === 3 && levels.every((level) => level <= 1)) options.background = levels;
  return options;
}
