// A ray through a box: where it enters, and the lattice of samples on it. The twin of player/march/box.py, which has the
// letters. A place on the ray is s, the distance behind the entry.

uniform vec3 uAabbMin, uCellsPerUnit;
uniform float uStep, uMostLength;
uniform int uResolution;

const float SKIP_MARGIN = 0.01;

vec3 rayPoint, rayDirection;
float rayT, rayLength;
float sampleS;

void enter(vec3 origin, vec3 direction) {
  float size = float(uResolution);
  rayPoint = (origin - uAabbMin) * uCellsPerUnit;
  rayDirection = direction * uCellsPerUnit;
  float tIn = 0.0, tOut = 1e30;
  for (int axis = 0; axis < 3; axis++) {
    float o = rayPoint[axis], d = rayDirection[axis];
    if (d == 0.0) {
      if (o < 0.0 || o > size) tOut = -1e30;
    } else {
      float a = -o / d, b = (size - o) / d;
      tIn = max(tIn, min(a, b));
      tOut = min(tOut, max(a, b));
    }
  }
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
int jumpFrom(int n, vec3 g, ivec3 brick, int reach) {
  vec3 ahead = vec3((brick + (reach + 1)) * 8) - SKIP_MARGIN, behind = vec3((brick - reach) * 8) + SKIP_MARGIN;
  float s = 1e6;
  for (int axis = 0; axis < 3; axis++) {
    float d = rayDirection[axis];
    if (d != 0.0) s = min(s, ((d > 0.0 ? ahead[axis] : behind[axis]) - rayPoint[axis]) / d);
  }
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
