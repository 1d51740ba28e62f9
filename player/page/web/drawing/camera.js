// Computes the rays of a view's pixels in the model frame; a view's camera is in the world frame.
//
// The ray through pixel (x, y) goes along centre + (x - px) across + (y - py) down, where `centre` has length 1 and is the
// direction of the ray through (px, py). If the camera is far away, (px, py) is where the middle of the box is seen, and
// rays begin beside the box: so float32 still resolves the differences between the pixels of the box.

import { add, column, dot } from "../viewer/pose.js";

const FAR_AWAY = 64; // distance beyond which a camera is far away, in half diagonals of the box

// Take a similarity [4][4] apart, x -> scale rotation x + move: { rotation [3][3], scale, move [3] }.
function similarity(matrix) {
  const scale = Math.hypot(matrix[0][0], matrix[0][1], matrix[0][2]);
  return { scale, rotation: matrix.slice(0, 3).map((row) => row.slice(0, 3).map((x) => x / scale)), move: matrix.slice(0, 3).map((row) => row[3]) };
}

// Return the values of the uniforms in rays.glsl and pixel.glsl that depend on the view's camera, by name.
export function raysOf(view, manifest) {
  const { scale, rotation, move } = similarity(manifest.world_from_model);
  const turn = (v) => [0, 1, 2].map((i) => rotation[0][i] * v[0] + rotation[1][i] * v[1] + rotation[2][i] * v[2]);
  const [right, up, back] = [0, 1, 2].map((i) => turn(column(view.c2w, i)));
  const eye = turn(add(column(view.c2w, 3), move, -1)).map((x) => x / scale);
  const [low, high] = manifest.aabb;
  const middle = low.map((x, i) => (x + high[i]) / 2), radius = Math.hypot(...low.map((x, i) => high[i] - x)) / 2;
  const way = add(middle, eye, -1), distance = Math.hypot(...way);
  const start = distance > FAR_AWAY * radius ? distance - radius : 0;
  const ahead = -dot(way, back);
  let pixel = [view.cx, view.cy];
  if (start && ahead > 0.01 * distance) {
    pixel = [view.cx + (view.fx * dot(way, right)) / ahead, view.cy - (view.fy * dot(way, up)) / ahead];
  }
  const centre = add(add(back.map((x) => -x), right, (pixel[0] - view.cx) / view.fx), up, -(pixel[1] - view.cy) / view.fy);
  const norm = Math.hypot(...centre), unit = centre.map((x) => x / norm);
  return {
    uOrigin: add(eye, unit, start), uStart: start, uCentre: unit, uPixel: pixel,
    uAcross: right.map((x) => x / (view.fx * norm)), uDown: up.map((x) => -x / (view.fy * norm)),
    uScale: scale, uDepths: [Math.max(distance - radius, 0) * scale, (distance + radius) * scale],
    uWorldFromModel: [0, 1, 2].flatMap((i) => rotation.map((row) => row[i])),
  };
}
