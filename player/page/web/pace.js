// How many pixels the next picture has: few while the camera moves, so that it moves smoothly, all once it stands still.
//
// The number while moving is found by feedback: the time that the last picture took, against the time that it may take.
// Nothing is assumed about the device, the scene or the view.

// Seconds that a picture may take while the camera moves.
export const FRAME_SECONDS = 1 / 30;
// Seconds that the first picture after a move may take, and the whole one: nothing can be done meanwhile.
const SHARP_SECONDS = 0.4, MOST_SECONDS = 8;
// Pixels of the smallest picture, in which something can still be recognised, and of the largest.
const LEAST = 96 * 72, MOST = 3840 * 2160;

// A window's size, made smaller in proportion until it has about so many `pixels` at most.
export function fitted(width, height, pixels) {
  const scale = Math.min(1, Math.sqrt(pixels / (width * height)));
  return [Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale))];
}

export class Pace {
  constructor(pixels = 30000) {
    this.pixels = pixels; // of a picture while the camera moves
    this.rate = pixels / FRAME_SECONDS; // pixels a second, of the last picture
  }

  // Learn from the seconds that a picture took while the camera moved. Times are whole frames of the screen, so one that
  // is well within what is allowed lets the next be somewhat larger, and between the two nothing changes.
  measured(pixels, seconds) {
    this.rate = pixels / Math.max(seconds, 1e-4);
    if (seconds > 1.2 * FRAME_SECONDS) this.pixels = pixels * Math.max(0.5, 0.9 * FRAME_SECONDS / seconds);
    else if (seconds < 0.6 * FRAME_SECONDS && pixels > 0.9 * this.pixels) this.pixels = 1.2 * pixels;
    this.pixels = Math.min(Math.max(this.pixels, LEAST), MOST);
  }

  // Learn from the seconds that a picture took while the camera stood still, which costs more than one while it moves: so
  // the first picture of the next move is not smaller than it need be.
  stood(pixels, seconds) {
    this.rate = pixels / Math.max(seconds, 1e-3);
    this.pixels = Math.min(Math.max(this.pixels, this.rate * FRAME_SECONDS / 2), MOST);
  }

  // Whether even the smallest picture takes so long that a turn would stutter.
  get stutters() {
    return this.pixels <= LEAST && this.rate < LEAST / (4 * FRAME_SECONDS);
  }

  // Sizes [width, height] of pictures in a window: while the camera moves, the first when it has stopped, the last.
  moving(width, height) {
    return fitted(width, height, this.pixels);
  }

  sharp(width, height) {
    return fitted(width, height, Math.max(this.pixels, this.rate * SHARP_SECONDS));
  }

  whole(width, height) {
    return fitted(width, height, Math.min(MOST, Math.max(this.pixels, this.rate * MOST_SECONDS)));
  }
}
