// A ray through contracted space. The twin of player/march/contracted.py, which explains the notation. A position on the ray
// is given by s, the angle from where the ray begins. The functions are those of box.glsl.

uniform vec3 uCellsPerUnit;
uniform float uStep, uNear;
uniform int uResolution, uLatticeSize;
uniform highp sampler2D uLattice; // s, cos(s) and sin(s) at every half base step

const float SKIP_MARGIN = 0.01;
const float MAX_SPEED = 2.23606798;
const float MIN_COS = 1e-3;
const float MOST_ANGLE = 1.56979633; // the angle whose cosine is MIN_COS

vec3 rayNearest, rayAlong;
float rayT, rayWidth, rayCos, raySin, rayLength;
float sampleS;
vec2 sampleTurn; // cos and sin of phi at the last sample

vec3 latticeAt(int i) {
  COUNT;
  i = min(i, uLatticeSize - 1);
  return texelFetch(uLattice, ivec2(i & 1023, int(float(i) * (1.0 / 1024.0))), 0).xyz;
}

void enter(vec3 origin, vec3 direction) {
  rayT = -dot(origin, direction);
  rayNearest = origin + rayT * direction;
  rayWidth = max(1.0, length(rayNearest));
  rayAlong = rayWidth * direction;
  float start = uNear - uStart - rayT, far = length(vec2(start, rayWidth));
  rayCos = rayWidth / far;
  raySin = start / far;
  rayLength = MOST_ANGLE - atan(start, rayWidth);
}

vec2 turned(float cosS, float sinS) {
  return vec2(rayCos * cosS - raySin * sinS, raySin * cosS + rayCos * sinS);
}

vec3 onGrid(vec2 turn) {
  vec3 v = turn.x * rayNearest + turn.y * rayAlong;
  float q = length(v), cells = uCellsPerUnit.x;
  float scale = q <= turn.x ? 1.0 / turn.x : (2.0 - turn.x / q) / q;
  return v * (scale * cells) + cells * 2.0;
}

vec3 placeOf(int n, int size) {
  vec3 found = latticeAt(2 * n + size - 1);
  sampleS = found.x;
  sampleTurn = turned(found.y, found.z);
  return onGrid(sampleTurn);
}

// Return cos and sin of a small angle.
vec2 smallTurn(float x) {
  float y = x * x;
  return vec2(1.0 - y * (0.5 - y * (1.0 / 24.0 - y / 720.0)), x * (1.0 - y * (1.0 / 6.0 - y * (1.0 / 120.0 - y / 5040.0))));
}

float wayOf(int size) {
  float angle = float(size) * uStep;
  vec2 turn = smallTurn(angle * 0.5);
  float a = sampleTurn.x * turn.x, b = sampleTurn.y * turn.y;
  return rayWidth * 2.0 * turn.x * turn.y / (max(a + b, MIN_COS) * max(a - b, MIN_COS));
}

int jumpFrom(int n, vec3 g, vec3 brick, float reach) {
  vec3 free = min(g - (brick - reach) * 8.0, (brick + reach + 1.0) * 8.0 - g);
  float least = min(free.x, min(free.y, free.z)) - SKIP_MARGIN;
  return n + max(int(floor(least / (MAX_SPEED * uStep * uCellsPerUnit.x))), 0) + 1;
}

// Return cos and sin of phi at any s, computed from the nearest entry of the lattice.
vec2 turnAt(float s) {
  int i = max(int(floor(s / (uStep * 0.5) + 0.5)) - 1, 0);
  vec3 found = latticeAt(i);
  vec2 rest = smallTurn(s - found.x);
  return turned(found.y * rest.x - found.z * rest.y, found.z * rest.x + found.y * rest.y);
}

vec3 placeAt(float s) {
  return onGrid(turnAt(s));
}

float distanceAt(float s) {
  vec2 turn = turnAt(s);
  return rayT + rayWidth * turn.y / max(turn.x, MIN_COS);
}

vec3 pulledBack(vec3 gradient) {
  vec3 v = sampleTurn.x * rayNearest + sampleTurn.y * rayAlong;
  float q = length(v);
  if (q <= sampleTurn.x) return gradient;
  float inverse = sampleTurn.x / q, across = (2.0 - inverse) * inverse;
  vec3 unit = v / q;
  return across * gradient + (inverse * inverse - across) * dot(unit, gradient) * unit;
}
