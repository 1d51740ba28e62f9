// Computes the rays of pixels: see camera.js.

uniform vec3 uCentre, uAcross, uDown;
uniform vec2 uPixel, uRows, uTile;
uniform float uStart; // how far from the camera rays begin

// Return the unit direction of the ray through a place in the tile that is drawn, and set turnedBy to how far it differs
// from uCentre.
vec3 turnedBy;
vec3 directionOf(vec2 place) {
  place += uTile;
  vec2 pixel = vec2(place.x, uRows.x + uRows.y * place.y) - uPixel;
  vec3 beside = pixel.x * uAcross + pixel.y * uDown;
  float more = 2.0 * dot(uCentre, beside) + dot(beside, beside), norm = sqrt(1.0 + more);
  turnedBy = (beside - uCentre * (more / (norm + 1.0))) / norm;
  return uCentre + turnedBy;
}
