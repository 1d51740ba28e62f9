// Mouse, fingers and keys move the camera.
//
//     drag, one finger            turn around the scene; look around while flying
//     right or Shift drag         move sideways; so do two fingers
//     wheel, pinch                nearer and away; ahead and back while flying
//     double click, double tap    turn around what was hit
//     arrow keys, + and -         turn, nearer and away; with Shift move sideways
//     W A S D Q E                 fly: ahead, left, back, right, down, up; faster with Shift

import { looked, moved, orbited, zoomed } from "./pose.js";

const WHEEL = { 0: 1, 1: 16, 2: 400 }; // pixels per unit of the wheel, by the event property deltaMode
const TURN_SPEED = 1.2; // radians a second, by key
const FLY_SPEED = 0.5; // radii of the orbit of the cameras a second
const KEY_SECONDS = 0.06; // a tap on a key moves as far as holding it for so many seconds
const TAP_SECONDS = 0.35, TAP_PIXELS = 12; // most time between the taps of a double tap, and most motion in a tap

// The effect of each held key, -1 to 1: [right, up, ahead] for flying, [to the right, to the top] for turning, and nearer for
// zooming.
const KEYS = {
  KeyD: [1, 0, 0, 0, 0, 0], KeyA: [-1, 0, 0, 0, 0, 0], KeyE: [0, 1, 0, 0, 0, 0], KeyQ: [0, -1, 0, 0, 0, 0],
  KeyW: [0, 0, 1, 0, 0, 0], KeyS: [0, 0, -1, 0, 0, 0],
  ArrowRight: [0, 0, 0, 1, 0, 0], ArrowLeft: [0, 0, 0, -1, 0, 0], ArrowUp: [0, 0, 0, 0, 1, 0],
  ArrowDown: [0, 0, 0, 0, -1, 0], "+": [0, 0, 0, 0, 0, 1], "=": [0, 0, 0, 0, 0, 1], "-": [0, 0, 0, 0, 0, -1],
};

export class Controls {
  // Listen on the viewer's canvas, and for keys in the whole page where no other control takes them.
  constructor(viewer) {
    this.viewer = viewer;
    this.flies = false;
    this.pointers = new Map(); // by pointerId: { x, y, sideways }
    this.held = new Map(); // name of each held key: whether Shift was held, too
    this.tap = { at: 0, x: 0, y: 0, moved: 0 };
    const { canvas } = viewer;
    if (window.self === window.top) this.engage();
    const on = (target, type, handler, options) => target.addEventListener(type, handler.bind(this), options);
    on(canvas, "pointerdown", this.down);
    on(canvas, "click", () => { // also by a tap
      this.engage();
      viewer.touch();
    });
    on(canvas, "pointermove", this.drag);
    for (const type of ["pointerup", "pointercancel"]) on(canvas, type, this.up);
    on(canvas, "wheel", this.wheel, { passive: false });
    for (const type of ["gesturestart", "gesturechange"]) on(canvas, type, this.pinch);
    on(canvas, "mousedown", (event) => event.button === 1 && event.preventDefault()); // the middle button would scroll
    on(canvas, "contextmenu", (event) => event.preventDefault());
    on(window, "keydown", this.keyDown);
    on(window, "keyup", this.keyUp);
    on(window, "blur", () => this.held.clear());
    on(document, "fullscreenchange", () => document.fullscreenElement && this.engage());
    viewer.step = (seconds) => this.step(seconds);
  }

  // Take the wheel and fingers from now on. An embedded page leaves them to the page around it until it is clicked or
  // fills the screen.
  engage() {
    this.engaged = true;
    this.viewer.canvas.style.touchAction = "none";
  }

  down(event) {
    const { viewer, pointers, tap } = this;
    if (!this.engaged && event.pointerType !== "mouse") return;
    this.engage();
    viewer.touch();
    viewer.canvas.setPointerCapture(event.pointerId);
    const sideways = event.button > 0 || event.shiftKey;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, sideways });
    tap.moved = pointers.size > 1 || event.button > 0 ? Infinity : 0;
  }

  drag(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const dx = event.clientX - pointer.x, dy = event.clientY - pointer.y;
    this.tap.moved += Math.hypot(dx, dy);
    const before = this.spread();
    Object.assign(pointer, { x: event.clientX, y: event.clientY });
    if (!dx && !dy) return;
    if (this.pointers.size === 1 && !pointer.sideways) return this.turn(dx, dy);
    const n = this.pointers.size; // each finger moves the mean of all fingers by its share
    this.slide(dx / n, dy / n);
    if (before) this.near(before / Math.max(this.spread(), 1));
  }

  up(event) {
    const { tap } = this;
    if (!this.pointers.delete(event.pointerId) || event.type === "pointercancel" || tap.moved > TAP_PIXELS) return;
    const [x, y] = [event.offsetX, event.offsetY];
    const double = event.timeStamp - tap.at < TAP_SECONDS * 1000 && Math.hypot(x - tap.x, y - tap.y) < 2 * TAP_PIXELS;
    Object.assign(tap, { at: double ? 0 : event.timeStamp, x, y });
    if (double) this.viewer.turnAround(x, y);
  }

  // Return the distance between two fingers in pixels; 0 if there is only one.
  spread() {
    const [a, b] = this.pointers.values();
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  }

  wheel(event) {
    if (!this.engaged) return;
    event.preventDefault();
    const pixels = event.deltaY * WHEEL[event.deltaMode] * (event.ctrlKey ? 6 : 1); // with Ctrl: a pinch on a touch pad
    this.near(Math.exp(Math.min(Math.max(pixels, -400), 400) * 0.0012));
  }

  // Follow a pinch on a touch pad in Safari on macOS, whose events have the scale since the pinch began.
  pinch(event) {
    if (!this.engaged || this.pointers.size) return; // fingers on a screen are followed by their pointers
    event.preventDefault();
    const before = event.type === "gesturestart" ? 1 : this.scale;
    this.scale = event.scale;
    this.near(before / event.scale);
  }

  // --- how gestures and keys move the camera ---

  turn(dx, dy) {
    const { frame, canvas } = this.viewer, angle = Math.PI / Math.max(canvas.clientHeight, 1);
    if (this.flies) this.viewer.move((pose) => looked(frame, pose, dx * angle / 2, dy * angle / 2));
    else this.viewer.move((pose) => orbited(pose, -dx * angle, dy * angle));
  }

  slide(dx, dy) {
    const { viewer } = this, { canvas, frame } = viewer;
    const { fx } = viewer.view(canvas.clientWidth, canvas.clientHeight);
    viewer.move((pose) => moved(frame, pose, -dx * pose.distance / fx, dy * pose.distance / fx, 0));
  }

  // Go nearer (factor below 1) or away.
  near(factor) {
    const { frame } = this.viewer;
    if (this.flies) this.viewer.move((pose) => moved(frame, pose, 0, 0, -Math.log(factor) * frame.radius));
    else this.viewer.move((pose) => zoomed(frame, pose, factor));
  }

  keyDown(event) {
    const name = KEYS[event.code] ? event.code : event.key;
    const taken = event.target.closest?.("select, input, dialog[open]");
    if (!KEYS[name] || taken || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    if (!this.held.has(name)) this.press(name, event.shiftKey, KEY_SECONDS);
    this.held.set(name, event.shiftKey);
    this.viewer.wake();
  }

  keyUp({ code, key }) {
    if (key === "Meta") this.held.clear(); // macOS does not tell of keys that are let go while Cmd is held
    for (const name of [code, key, "+", "=", "-"]) this.held.delete(name);
  }

  // Move as the held keys say, for so many seconds; return whether any key is held.
  step(seconds) {
    for (const [name, shift] of this.held) this.press(name, shift, seconds);
    return this.held.size > 0;
  }

  press(name, shift, seconds) {
    const { viewer } = this, { frame } = viewer;
    const [right, up, ahead, turnRight, turnUp, nearer] = KEYS[name];
    const way = FLY_SPEED * frame.radius * seconds, angle = TURN_SPEED * seconds;
    if (turnRight || turnUp) {
      if (shift) viewer.move((pose) => moved(frame, pose, turnRight * way, turnUp * way, 0));
      else if (this.flies) viewer.move((pose) => looked(frame, pose, -turnRight * angle, turnUp * angle));
      else viewer.move((pose) => orbited(pose, turnRight * angle, turnUp * angle));
    } else if (nearer) {
      this.near(Math.exp(-nearer * seconds));
    } else {
      const far = way * (shift ? 3 : 1);
      viewer.move((pose) => moved(frame, pose, right * far, up * far, ahead * far));
    }
  }
}
