// A ray through a box: where the ray enters, and the lattice of samples on it. The twin of player/march/box.py. A position on
// the ray is given by s, the distance from the entry in model units.

uniform vec3 uAabbMin, uCellsPerUnit;
uniform float uStep, uMostLength;
uniform int uResolution;

const float SKIP_MARGIN = 0.01;

vec3 rayPoint, rayDirection, rayInverse, rayAhead; // rayInverse: 1 / direction; rayAhead: 1 where direction is positive, else 0
vec3 rayNever; // large along the axes on which the ray does not move, else 0
float rayT, rayLength;
float sampleS;

void enter(vec3 origin, vec3 direction) {
  float size = float(uResolution);
  rayPoint = (origin - uAabbMin) * uCellsPerUnit;
  rayDirection = direction * uCellsPerUnit;
  bvec3 still = equal(rayDirection, vec3(0));
  vec3 moving = mix(rayDirection, vec3(1), still);
  rayInverse = 1.0 / moving;
  rayNever = mix(vec3(0), vec3(1e6), still);
  rayAhead = vec3(greaterThan(rayDirection, vec3(0)));
  vec3 a = -rayPoint / moving, b = (size - rayPoint) / moving;
  vec3 near = mix(min(a, b), vec3(0), still), far = mix(max(a, b), vec3(1e30), still);
  float tIn = max(max(near.x, near.y), max(near.z, 0.0)), tOut = min(far.x, min(far.y, far.z));
  vec3 outside = vec3(notEqual(rayPoint, clamp(rayPoint, vec3(0), vec3(size))));
  if (dot(outside, rayNever) > 0.0) tOut = -1e30;
  rayPoint = clamp(rayPoint + tIn * rayDirection, vec3(0), vec3(size));
  rayT = tIn;
  rayLength = min(tOut - tIn, uMostLength);
}

// Return the grid coordinates of the middle of `size` base steps from n on, and set sampleS to its position on the ray.
vec3 placeOf(int n, int size) {
  sampleS = (float(n) + float(size) * 0.5) * uStep;
  return rayPoint + sampleS * rayDirection;
}

// Return the length of ray, in model units, that the sample of the last placeOf stands for.
float wayOf(int size) {
  return float(size) * uStep;
}

// Return the next base step to look at after step n, whose middle is at g in `brick`. All bricks up to a distance of `reach`
// from that brick are empty.
int jumpFrom(int n, vec3 g, vec3 brick, float reach) {
  vec3 end = (brick - reach + rayAhead * (2.0 * reach + 1.0)) * 8.0 + SKIP_MARGIN * (1.0 - 2.0 * rayAhead);
  vec3 way = (end - rayPoint) * rayInverse * vec3(equal(rayNever, vec3(0))) + rayNever;
  float s = min(way.x, min(way.y, way.z));
  return max(n, int(floor(min(s / uStep - 0.5, 1e9)))) + 1;
}

vec3 placeAt(float s) {
  return rayPoint + s * rayDirection;
}

float distanceAt(float s) {
  return rayT + s;
}

// Return, in the model frame, a gradient at the sample of the last placeOf. It is given along the grid's axes, in codes per
// model unit.
vec3 pulledBack(vec3 gradient) {
  return gradient;
}
