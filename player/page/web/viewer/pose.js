// The camera's mathematics: pure functions of numbers, for the page's viewer.
//
// A frame describes how a scene is looked at: { axes: [east, north, up], radius }. `axes` are three unit vectors at right
// angles; `radius` is the cameras' median distance from the point that they look at, in world units.
//
// A pose describes a camera by the point that it turns around:
//
//     { target: [3], distance, azimuth, elevation, roll, lens: { x, y, shiftX, shiftY, pixel } }
//
// target: the point, world frame; distance: from there to the camera, world units; azimuth, elevation, roll: radians, in the
// axes of a frame, where straight up is elevation 90 degrees; roll is positive if the camera is turned anticlockwise.
// lens: x and y are the tangents of half the angles of view that have to fit into the window; shiftX and shiftY are the
// position of the optical axis, in pixels from the middle, divided by the focal length fx; pixel is fy / fx.
//
// Cameras' matrices c2w are 16 numbers, row by row, OpenGL axes: x right, y up, and the camera looks along -z.

export const add = (a, b, scale = 1) => a.map((value, i) => value + scale * b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const column = (c2w, i) => [c2w[i], c2w[i + 4], c2w[i + 8]];
const clamped = (value, low, high) => Math.min(Math.max(value, low), high);
const mean = (vectors) => [0, 1, 2].map((i) => vectors.reduce((sum, v) => sum + v[i], 0) / vectors.length);

function unit(vector, otherwise) {
  const length = Math.hypot(...vector);
  return length > 1e-9 ? vector.map((value) => value / length) : otherwise;
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b), half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}

// Solve the 3 equations (A + weight I) x = b by Cramer's rule, where A is the mean of v v^T over the vectors; with `across`
// the mean of I - v v^T.
function solved(vectors, weight, b, across) {
  const rows = [0, 1, 2].map((i) => [0, 1, 2].map((j) => {
    const product = vectors.reduce((sum, v) => sum + v[i] * v[j], 0) / vectors.length;
    return (across ? (i === j) - product : product) + (i === j ? weight : 0);
  }));
  const determinant = dot(rows[0], cross(rows[1], rows[2]));
  const columns = [cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])];
  return [0, 1, 2].map((i) => columns.reduce((sum, c, j) => sum + c[i] * b[j], 0) / determinant);
}

// Return the world's up, the direction most nearly at right angles to the cameras' right-hand directions. The twin of
// `world_up` in player/cameras/camera.py.
export function worldUp(cameras) {
  const ups = cameras.map((camera) => column(camera.c2w, 1));
  const average = unit(mean(ups), ups[0]), weight = 1e-3;
  return unit(solved(cameras.map((camera) => column(camera.c2w, 0)), weight, average.map((v) => v * weight)), average);
}

// Return the point that is nearest to all optical axes; if it is behind the cameras, a point ahead of the mean camera. The
// twin of `focus_point` in player/cameras/camera.py.
export function focusPoint(cameras) {
  const origins = cameras.map((camera) => column(camera.c2w, 3));
  const forwards = cameras.map((camera) => unit(column(camera.c2w, 2).map((v) => -v), [0, 0, -1]));
  const middle = mean(origins);
  const arms = origins.map((origin) => add(origin, middle, -1));
  const unitLength = Math.sqrt(arms.reduce((sum, arm) => sum + dot(arm, arm), 0) / arms.length) || 1;
  const ahead = unit(mean(forwards), [0, 0, 0]), weight = 1e-7;
  const b = mean(arms.map((arm, i) => add(arm, forwards[i], -dot(arm, forwards[i])).map((v) => v / unitLength)));
  const point = solved(forwards, weight, add(b, ahead, weight), true);
  const depths = forwards.map((forward, i) => dot(add(point, arms[i], -1 / unitLength), forward));
  return add(middle, median(depths) > -1e-6 ? point : ahead, unitLength);
}

// Return { frame, pose }: the frame { axes, radius } of some cameras, and the pose to begin with. That pose is level, at the
// cameras' median distance and elevation from what they look at, and in the mean of their directions from there; where
// cameras stand all around, in the direction of the first.
export function restOf(cameras) {
  const up = worldUp(cameras), target = focusPoint(cameras);
  const arms = cameras.map((camera) => add(column(camera.c2w, 3), target, -1));
  const flat = arms.map((arm) => unit(add(arm, up, -dot(arm, up)), [0, 0, 0]));
  const least = [0, 1, 2].reduce((best, i) => (Math.abs(up[i]) < Math.abs(up[best]) ? i : best), 0);
  const east = unit(flat[0], unit(cross(up, [0, 1, 2].map((i) => +(i === least))), up));
  const axes = [east, cross(up, east), up];
  const middle = mean(flat);
  const radii = arms.map((arm) => Math.hypot(...arm));
  const radius = median(radii) || 1;
  const azimuth = Math.hypot(...middle) > 0.2 ? Math.atan2(dot(middle, axes[1]), dot(middle, axes[0])) : 0;
  const heights = arms.map((arm, i) => Math.asin(clamped(dot(arm, up) / Math.max(radii[i], 1e-12), -1, 1)));
  const elevation = clamped(median(heights), -MOST_ELEVATION, MOST_ELEVATION);
  const lens = { ...lensOf(cameras[0]), shiftX: 0, shiftY: 0 };
  const pose = { target, distance: radius, azimuth, elevation, roll: 0, lens };
  return { frame: { axes, radius }, pose };
}

// The steepest elevations of the first pose and of moves: straight above, left and right mean nothing.
const MOST_ELEVATION = 85 / 180 * Math.PI;
const STEEPEST = 89.5 / 180 * Math.PI;

function lensOf({ width, height, fx, fy, cx, cy }) {
  return {
    x: width / 2 / fx, y: height / 2 / fy, pixel: fy / fx,
    shiftX: (cx - width / 2) / fx, shiftY: (cy - height / 2) / fx,
  };
}

// Return the pose of a camera with a matrix and a lens, which turns around a point `distance` ahead of it.
function poseFrom({ axes }, c2w, distance, lens) {
  const back = unit(column(c2w, 2), [0, 0, 1]), right = column(c2w, 0);
  const [east, north, up] = axes.map((axis) => dot(axis, back));
  const azimuth = Math.hypot(east, north) > 1e-9 ? Math.atan2(north, east) : 0;
  const elevation = Math.asin(clamped(up, -1, 1));
  const level = cameraOf({ axes }, { target: [0, 0, 0], distance: 0, azimuth, elevation, roll: 0 });
  const roll = Math.atan2(dot(right, column(level, 1)), dot(right, column(level, 0)));
  return { target: add(column(c2w, 3), back, -distance), distance, azimuth, elevation, roll, lens };
}

// Return the pose of a training view. It turns around a point as far ahead as `focus`, the point that all cameras look at;
// if `focus` is not ahead, the point is as far ahead as the frame's radius.
export function poseOf(frame, camera, focus) {
  const ahead = -dot(add(focus, column(camera.c2w, 3), -1), unit(column(camera.c2w, 2), [0, 0, 1]));
  return poseFrom(frame, camera.c2w, ahead > frame.radius / 10 ? ahead : frame.radius, lensOf(camera));
}

// Return the matrix c2w, 16 numbers row by row, of a pose.
export function cameraOf({ axes }, { target, distance, azimuth, elevation, roll }) {
  const [east, north, up] = axes;
  const along = add(east.map((v) => v * Math.cos(azimuth)), north, Math.sin(azimuth));
  const level = add(north.map((v) => v * Math.cos(azimuth)), east, -Math.sin(azimuth));
  const back = add(along.map((v) => v * Math.cos(elevation)), up, Math.sin(elevation));
  const above = cross(back, level);
  const right = add(level.map((v) => v * Math.cos(roll)), above, Math.sin(roll));
  const top = cross(back, right), place = add(target, back, distance);
  return [...[0, 1, 2].flatMap((i) => [right[i], top[i], back[i], place[i]]), 0, 0, 0, 1];
}

// Return the renderer's view of a pose in a window of `width` x `height` pixels. The whole angle of view fits in.
export function viewOf(frame, pose, width, height) {
  const { x, y, shiftX, shiftY, pixel } = pose.lens;
  const fx = Math.min(width / 2 / x, height / 2 / y / pixel);
  return {
    c2w: cameraOf(frame, pose), fx, fy: fx * pixel,
    cx: width / 2 + shiftX * fx, cy: height / 2 + shiftY * fx, width, height,
  };
}

// --- moves: each takes a pose and returns another ---

// Return the roll after a turn. It decreases as the camera turns, so that a visitor who turns the scene soon finds it upright.
const levelled = (roll, turned) => roll * Math.exp(-2 * turned);

// Turn around the target, by angles in radians.
export function orbited(pose, right, up) {
  const elevation = clamped(pose.elevation + up, -STEEPEST, STEEPEST);
  return { ...pose, azimuth: pose.azimuth + right, elevation, roll: levelled(pose.roll, Math.hypot(right, up)) };
}

// Turn the camera where it stands, by angles in radians to the left and upwards.
export function looked(frame, pose, left, up) {
  const elevation = clamped(pose.elevation - up, -STEEPEST, STEEPEST);
  const turned = { ...pose, azimuth: pose.azimuth + left, elevation, roll: levelled(pose.roll, Math.hypot(left, up)) };
  const before = cameraOf(frame, pose), after = cameraOf(frame, turned);
  return { ...turned, target: add(turned.target, add(column(before, 3), column(after, 3), -1)) };
}

// Move the camera and its target together, by world units to the right, to the top and ahead of the camera.
export function moved(frame, pose, right, up, ahead) {
  const c2w = cameraOf(frame, pose);
  const way = add(add(column(c2w, 0).map((v) => v * right), column(c2w, 1), up), column(c2w, 2), -ahead);
  return { ...pose, target: add(pose.target, way) };
}

// Go nearer (factor below 1) or away.
export function zoomed(frame, pose, factor) {
  return { ...pose, distance: clamped(pose.distance * factor, frame.radius * 1e-3, frame.radius * 1e3) };
}

// Look at a point from where the camera is, and turn around that point from now on.
export function aimed(frame, pose, point) {
  const place = column(cameraOf(frame, pose), 3), arm = add(place, point, -1);
  const distance = Math.hypot(...arm), back = unit(arm, column(cameraOf(frame, pose), 2));
  const [east, north, up] = frame.axes.map((axis) => dot(axis, back));
  const elevation = clamped(Math.asin(clamped(up, -1, 1)), -STEEPEST, STEEPEST);
  return { ...pose, target: point, distance, azimuth: Math.atan2(north, east), elevation };
}

// Return the point at distance `t` along the ray through (x, y) of a view, in pixels from its upper left corner.
export function pointAt({ c2w, fx, fy, cx, cy }, x, y, t) {
  const [right, top, back, place] = [0, 1, 2, 3].map((i) => column(c2w, i));
  const direction = add(add(back.map((v) => -v), right, (x - cx) / fx), top, (cy - y) / fy);
  return add(place, unit(direction, back), t);
}

// Interpolate between two poses, a share 0..1 of the way. Azimuth and roll go around by the shorter way.
export function between(from, to, share) {
  const mix = (a, b) => a + (b - a) * share;
  const turn = (a, b) => a + Math.atan2(Math.sin(b - a), Math.cos(b - a)) * share;
  const lens = {};
  for (const key in from.lens) lens[key] = mix(from.lens[key], to.lens[key]);
  return {
    target: from.target.map((value, i) => mix(value, to.target[i])),
    distance: from.distance * (to.distance / from.distance) ** share,
    azimuth: turn(from.azimuth, to.azimuth), elevation: mix(from.elevation, to.elevation),
    roll: turn(from.roll, to.roll), lens,
  };
}

// Return how far apart two poses are: the sum of differences of angles, relative distances, and logarithms of ratios.
export function difference(a, b) {
  const angle = (from, to) => Math.abs(Math.atan2(Math.sin(to - from), Math.cos(to - from)));
  return Math.hypot(...add(a.target, b.target, -1)) / b.distance + Math.abs(Math.log(a.distance / b.distance))
    + angle(a.azimuth, b.azimuth) + Math.abs(a.elevation - b.elevation) + angle(a.roll, b.roll)
    + Math.abs(Math.log(a.lens.x / b.lens.x)) + Math.abs(a.lens.shiftX - b.lens.shiftX);
}
