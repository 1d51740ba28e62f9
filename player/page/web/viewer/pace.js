// Chooses how many pixels the next picture has: few while the camera moves, so that it moves smoothly, all once it stands
// still.
//
// The number while the camera moves is found by feedback, from the time that the last picture took and the time that it
// may take. Nothing is assumed about the device, the scene or the view.

// Seconds that a picture may take while the camera moves.
export const FRAME_SECONDS = 1 / 30;
// Seconds that the first picture after a move may take, and seconds that one at full size may take: the page can draw
// nothing else meanwhile.
const SHARP_SECONDS = 0.4, MOST_SECONDS = 8;
// Pixels of the smallest picture, in which something can still be recognised, and of the largest.
const LEAST = 96 * 72, MOST = 3840 * 2160;

// Return a window's size, scaled down in proportion until it has at most about `pixels` pixels.
export function fitted(width, height, pixels) {
  const scale = Math.min(1, Math.sqrt(pixels / (width * height)));
  return [Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale))];
}

export class Pace {
  constructor(pixels = 30000) {
    this.pixels = pixels; // of a picture while the camera moves
    this.rate = pixels / FRAME_SECONDS; // pixels a second, of the last picture
  }

  // Adapt to the seconds that a picture took while the camera moved. Times are whole frames of the screen. So the next
  // picture is smaller after a time clearly above the target, somewhat larger after one well below it, and else the same.
  // `atOnce`: whether the picture was finished by the screen's next frame. A screen of 50 frames a second cannot tell shorter
  // times, so there a picture may be well below the target although its measured time is not.
  measured(pixels, seconds, atOnce) {
    this.rate = pixels / Math.max(seconds, 1e-4);
    const fast = (atOnce ? 0.8 : 0.6) * FRAME_SECONDS;
    if (seconds > 1.2 * FRAME_SECONDS) this.pixels = pixels * Math.max(0.5, 0.9 * FRAME_SECONDS / seconds);
    else if (seconds < fast && pixels > 0.9 * this.pixels) this.pixels = 1.2 * pixels;
    this.pixels = Math.min(Math.max(this.pixels, LEAST), MOST);
  }

  // Adapt to the seconds that a picture took while the camera stood still, so that the first picture of the next move is
  // not smaller than necessary. A picture that is drawn while the camera moves costs less.
  stood(pixels, seconds) {
    this.rate = pixels / Math.max(seconds, 1e-3);
    this.pixels = Math.min(Math.max(this.pixels, this.rate * FRAME_SECONDS / 2), MOST);
  }

  // True if even the smallest picture takes so long that a turn would stutter.
  get stutters() {
    return this.pixels <= LEAST && this.rate < LEAST / (4 * FRAME_SECONDS);
  }

  // Return the size [width, height] of a picture in a window: while the camera moves (`moving`), of the first picture after
  // it has stopped (`sharp`), and of those at full size (`whole`).
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
