// Controls what is on the screen: the pose of the camera, how it moves, and which picture is drawn when.
//
// The camera follows a goal, a pose that controls change, or flies to the goal along a path of its own. While it moves,
// pictures are small enough for 30 a second. Once it stands still, a picture follows that takes some tenths of a second,
// then one at full size, and then more of these, each shifted by a fraction of a pixel, of which the renderer shows the
// mean. Then nothing is drawn until something changes. No picture is begun before the last one is finished.

import { aimed, between, difference, orbited, pointAt, poseOf, restOf, viewOf } from "./pose.js";
import { Pace } from "./pace.js";

const STILL_SECONDS = 0.15; // without a move, after which the camera counts as still
const EASE_SECONDS = 0.07; // in which the camera goes most of the way to the goal
const FLIGHT_SECONDS = 1.2;
const TURN_SPEED = 0.12; // radians a second
const REST_SECONDS = 6; // without a touch, after which the slow turn begins again, if asked for
const N_WHOLE = 8; // pictures at full size, of which the mean is shown
const FEW_SECONDS = 1; // if a picture takes longer, no further ones are drawn for the mean

// Return the n-th number of van der Corput's sequence for a base, which fills 0..1 evenly.
function spread(n, base) {
  let value = 0;
  for (let part = 1 / base; n > 0; n = Math.floor(n / base), part /= base) value += (n % base) * part;
  return value;
}

export class Viewer {
  // `cameras`: the training views; `options`: those of the page's address; `calm`: whether the visitor wants no motion;
  // `background`: the scene's own.
  constructor(canvas, renderer, cameras, options, calm, background) {
    this.canvas = canvas;
    this.renderer = renderer;
    this.calm = calm;
    const { frame, pose } = restOf(cameras);
    this.frame = frame;
    this.rest = pose;
    this.views = cameras.map((camera) => poseOf(frame, camera, pose.target));
    this.pose = this.goal = this.views[options.view] ?? pose;
    this.flight = null; // { from, begin } while a flight is under way
    this.step = () => false; // moves the goal as time passes: (seconds) => whether it did
    this.onturn = this.onview = () => {};
    this.turning = options.view === undefined;
    this.own = background;
    this.layer = "colour";
    this.pace = new Pace();
    this.covered = this.pose === pose; // the poster, which shows this pose, stays until all of the scene is there
    this.touchedAt = this.before = performance.now();
    this.asked = 0; // the request for the next tick
    // The picture that is being drawn: { sync, begin, moving, ticks: how many have come since, hidden: whether the page was, or its canvas }.
    this.fence = null;
    new ResizeObserver(() => this.refresh()).observe(canvas);
    const away = () => {
      if (this.fence) this.fence.hidden = true;
    };
    document.addEventListener("visibilitychange", away);
    new IntersectionObserver(([seen]) => seen.isIntersecting || away()).observe(canvas); // an iframe that is scrolled away
    this.follow(options);
    this.watch();
  }

  // Follow the options of the page's address, other than its view.
  follow({ turn, quality = "high", background = this.own }) {
    this.again = turn === true && !this.calm;
    this.set({ quality, background });
    this.turn(!this.calm && (turn ?? this.turning));
  }

  // Draw anew, now and whenever a CSS pixel gets more or fewer pixels of the screen, as when the window moves to another one.
  watch() {
    this.refresh();
    const same = matchMedia(`(resolution: ${devicePixelRatio}dppx)`);
    same.addEventListener("change", () => this.watch(), { once: true });
  }

  // Draw anew, because something other than the camera has changed.
  refresh() {
    this.stale = true;
    this.n_still = 0; // pictures drawn since the camera has stood still
    this.movedAt = performance.now();
    this.wake();
  }

  wake() {
    this.asked ||= requestAnimationFrame((now) => {
      this.asked = 0;
      this.tick(now);
    });
  }

  set(changes) {
    Object.assign(this, changes);
    this.refresh();
  }

  // Show the scene in place of the poster from now on, because all of it is there or a visitor has touched it.
  uncover() {
    this.covered = false;
    this.refresh();
  }

  // Change the goal by a function that takes a pose and returns another.
  move(change) {
    this.touch();
    this.goal = change(this.goal);
    this.flight = null;
    this.onview(-1);
    this.wake();
  }

  // Note that a visitor has done something. This ends the slow turn.
  touch() {
    this.touchedAt = performance.now();
    if (this.covered) this.uncover();
    if (this.turning) this.turn(false);
  }

  turn(on) {
    this.turning = on;
    this.onturn(on);
    this.wake();
  }

  fly(goal) {
    this.touch();
    this.goal = goal;
    this.flight = this.calm ? null : { from: this.pose, begin: performance.now() };
    this.wake();
  }

  flyToView(index) {
    if (!this.views[index]) return;
    this.fly(this.views[index]);
    this.onview(index);
  }

  flyHome() {
    this.fly(this.rest);
    this.onview(-1);
  }

  // Turn the camera, from now on, around what is seen at (x, y) of the canvas, in CSS pixels.
  async turnAround(x, y) {
    const { clientWidth, clientHeight } = this.canvas;
    const view = this.view(clientWidth, clientHeight);
    this.touch();
    const t = await this.renderer.depthAt({ ...view, quality: this.quality }, x, y).catch(() => null); // the context is lost
    if (t !== null) this.fly(aimed(this.frame, this.pose, pointAt(view, x, y, t)));
  }

  // Render the picture in the window at full size; resolve to { width, height, rgba }.
  picture() {
    const { layer, quality, background } = this;
    return this.renderer.render({ ...this.view(...this.size()), layer, quality, background });
  }

  // Return the size [width, height] of the canvas in pixels of the screen.
  size() {
    const scale = window.devicePixelRatio || 1, { clientWidth, clientHeight } = this.canvas;
    return [Math.max(1, Math.round(clientWidth * scale)), Math.max(1, Math.round(clientHeight * scale))];
  }

  view(width, height) {
    return viewOf(this.frame, this.pose, width, height);
  }

  tick(now) {
    const seconds = Math.min(Math.max((now - this.before) / 1000, 0), 0.1);
    this.before = now;
    if (this.renderer.lost || this.covered) return;
    if (this.fence && !this.finished()) return this.wake();
    const moves = this.advance(now, seconds);
    if (moves) {
      this.movedAt = now;
      this.n_still = 0;
    }
    if (moves || this.stale) this.draw(this.pace.moving(...this.size()), { quality: "fast", moving: moves });
    else if (now - this.movedAt >= STILL_SECONDS * 1000) this.sharpen();
    if (this.fence || this.flight || this.n_still <= N_WHOLE || this.turning || this.again) this.wake();
  }

  // Bring the pose nearer to the goal; return whether it moved.
  advance(now, seconds) {
    if (this.turning && this.pace.stutters) this.turn(false);
    if (this.again && !this.turning && now - this.touchedAt > REST_SECONDS * 1000 && !this.pace.stutters) this.turn(true);
    if (this.step(seconds)) this.touchedAt = now;
    if (this.turning && this.canvas.dataset.shown) this.goal = orbited(this.goal, TURN_SPEED * seconds, 0);
    const before = this.pose;
    if (this.flight) {
      // A frame's time may lie before the click that began the flight.
      const share = Math.min(Math.max((now - this.flight.begin) / 1000 / FLIGHT_SECONDS, 0), 1);
      this.pose = between(this.flight.from, this.goal, share * share * (3 - 2 * share));
      if (share >= 1) this.flight = null;
    } else {
      this.pose = between(before, this.goal, this.calm ? 1 : 1 - Math.exp(-seconds / EASE_SECONDS));
    }
    if (!this.flight && difference(this.pose, this.goal) < 2e-4) this.pose = this.goal;
    return this.pose !== before && difference(this.pose, before) > 0;
  }

  // Draw the next picture of a camera that stands still.
  sharpen() {
    const { quality, pace } = this, size = this.size(), sharp = pace.sharp(...size);
    if (this.n_still === 0 && sharp[0] === size[0]) this.n_still = 1;
    const n = this.n_still - 1; // pictures at full size so far
    if (n > 0 && (this.layer !== "colour" || this.seconds > FEW_SECONDS)) this.n_still = N_WHOLE + 1;
    if (this.n_still > N_WHOLE) {
      this.canvas.dataset.done = "";
      return;
    }
    this.n_still += 1;
    const jitter = n > 0 ? [spread(n, 2) - 0.5, spread(n, 3) - 0.5] : [0, 0];
    if (n < 0) this.draw(sharp, { quality });
    else this.draw(n ? this.drawn : pace.whole(...size), { quality, jitter, accumulate: true });
  }

  draw([width, height], { quality, jitter = [0, 0], accumulate = false, moving = false }) {
    if (String(this.drawn) !== `${width},${height}`) this.renderer.resize(width, height);
    this.drawn = [width, height];
    this.stale = false;
    delete this.canvas.dataset.done;
    const { layer, background } = this, begin = performance.now();
    this.renderer.draw({ ...this.view(width, height), quality, background, layer, jitter, accumulate });
    const gl = this.canvas.getContext("webgl2");
    this.fence = { sync: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), begin, moving, ticks: 0 };
    gl.flush();
  }

  // Return whether the last picture is finished. If it is, the pace adapts to the time that the picture took. If the page
  // was hidden meanwhile, when no ticks come, that time says nothing, and the picture is drawn anew.
  finished() {
    const gl = this.canvas.getContext("webgl2"), { sync, begin, moving, hidden } = this.fence;
    const ticks = ++this.fence.ticks;
    if (gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(sync);
    this.fence = null;
    this.seconds = (performance.now() - begin) / 1000;
    const pixels = this.drawn[0] * this.drawn[1];
    if (hidden) this.refresh();
    else if (moving) this.pace.measured(pixels, this.seconds, ticks === 1);
    else this.pace.stood(pixels, this.seconds);
    // data-shown: the size of the picture on the screen; data-done: no more pictures come until something changes
    if (moving || this.n_still > 0) this.canvas.dataset.shown = this.drawn.join("x");
    return true;
  }

  // Draw anew after the graphics card is back, which has lost everything.
  restored() {
    this.fence = null;
    this.refresh();
  }
}
