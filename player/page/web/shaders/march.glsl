// Marches a ray from sample to sample. The twin of player/march/march.py, which explains the notation.

uniform float uMostTau;
uniform vec2 uDensityCode; // log sigma at code 0, and its slope
uniform int uLevelSteps[8], uLongestStep; // most base steps that a sample of each level, and of any level, stands for

struct March {
  int n; // the base step to go on with
  float tau;
  vec3 brick; // place of the last lookup, in bricks of the finest level
  ivec3 first; // first texel of the densities of the brick there
  int reach; // distance in bricks up to which all places around are empty; -1 with a brick
  float scale; // cells of its level per cell of the finest level, along an axis
  int size; // most base steps that a sample that begins there stands for
};

March begun() {
  return March(0, 0.0, vec3(-1), ivec3(0), 0, 1.0, 1);
}

vec3 gradientSum = vec3(0);

void lookAt(inout March march, vec3 cell) {
  vec3 brick = floor(cell * 0.125);
  if (brick == march.brick) return;
  march.brick = brick;
  ivec4 entry = tableAt(ivec3(brick));
  march.reach = entry.w < MANY ? entry.w - 1 : -1;
  if (entry.w < MANY) {
    march.size = entry.x > 0 ? uLevelSteps[entry.x] : 1;
    return;
  }
  march.first = entry.xyz * ivec3(8, 8, 10);
  march.scale = 1.0 / float(1 << (entry.w - MANY));
  march.size = uLevelSteps[entry.w - MANY];
}

vec3 cellOf(vec3 g) {
  return clamp(floor(g), vec3(0), vec3(uResolution - 1));
}

// Interpolate the code at g, which is in `cell` of the finest level, in the brick of the last lookup; for normals also find
// its slope. Returns false if the brick's cell is not live.
bool codeAt(March march, vec3 g, vec3 cell, out float code, out vec3 slope) {
  vec3 own = floor(cell * march.scale), share = g * march.scale - own;
  ivec3 local = ivec3(own) & 7, at = march.first + local;
  int live = int(densityAt(ivec3(at.xy, march.first.z + 9)).r * 255.0 + 0.5);
  if ((live & (1 << local.z)) == 0) return false;
  // The four corners are (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1).
  vec4 low = densityAt(at) * 255.0, high = densityAt(at + ivec3(0, 0, 1)) * 255.0;
  vec4 e = low + (high - low) * share.z;
  vec2 f = e.xz + (e.yw - e.xz) * share.y;
  code = f.x + (f.y - f.x) * share.x;
#ifdef NORMALS
  vec4 d = high - low;
  vec2 up = mix(d.xz, d.yw, share.y);
  slope = vec3(f.y - f.x, mix(e.y - e.x, e.w - e.z, share.x), mix(up.x, up.y, share.x)) * march.scale;
#endif
  return true;
}

// Return -expm1(-x), by its series if x is small.
float alphaOf(float x) {
  return x < 0.03 ? x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0)))) : 1.0 - exp(-x);
}

// Go on by one step: a jump over empty space, or a sample at s with a weight. The weight is 0 if there is no sample. Returns
// false at the ray's end.
bool stepOn(inout March march, out float s, out float weight) {
  weight = 0.0;
  vec3 g = placeOf(march.n, 1);
  if (!(sampleS < rayLength) || march.tau > uMostTau) return false;
  vec3 cell = cellOf(g);
  lookAt(march, cell);
  int size = march.size;
  if (march.n != 0) size = min(size, march.n & -march.n);
  if (march.reach >= 0) {
    int there = jumpFrom(march.n, g, march.brick, float(march.reach)), after = march.n + size;
    if (after <= there) { // otherwise the middle of the sample may be in a live cell
      march.n = max(there & -uLongestStep, after); // a step that every march visits
      return true;
    }
  }
  if (size > 1) {
    g = placeOf(march.n, size);
    cell = cellOf(g);
    lookAt(march, cell);
  }
  march.n += size;
  float code;
  vec3 slope;
  if (march.reach >= 0 || !(sampleS < rayLength) || !codeAt(march, g, cell, code, slope)) return true;
  float optical = exp(uDensityCode.x + uDensityCode.y * code) * wayOf(size);
  s = sampleS;
  weight = exp(-march.tau) * alphaOf(optical);
  march.tau += optical;
#ifdef NORMALS
  gradientSum -= weight * pulledBack(slope * uCellsPerUnit);
#endif
  return true;
}
