// A ray through a box: where it enters, and the lattice of samples on it. The twin of player/march/box.py, which has the
// letters. A place on the ray is s, the distance behind the entry.

uniform vec3 uAabbMin, uCellsPerUnit;
uniform float uStep, uMostLength;
uniform int uResolution;

const float SKIP_MARGIN = 0.01;

vec3 rayPoint, rayDirection, rayInverse, rayAhead; // 1 / direction, and 1 along the axes where it is positive
vec3 rayNever; // large along the axes that the ray does not move on
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

// Grid coordinates of the middle of `size` base steps from n on, and in sampleS where that is on the ray.
vec3 placeOf(int n, int size) {
  sampleS = (float(n) + float(size) * 0.5) * uStep;
  return rayPoint + sampleS * rayDirection;
}

// Model units that the sample of the last placeOf stands for.
float wayOf(int size) {
  return float(size) * uStep;
}

// The next base step to look at, after step n, whose middle is at g in a brick around which all within `reach` are empty.
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

// A gradient along the grid's axes, codes a model unit, at the sample of the last placeOf, in the model frame.
vec3 pulledBack(vec3 gradient) {
  return gradient;
}
