// The march of a ray from sample to sample: the twin of player/march/march.py, which has the letters.

uniform float uMostTau;
uniform vec2 uDensityCode; // log sigma at code 0, and its slope
uniform int uLevelSteps[8];

struct March {
  int n; // the base step to go on with
  float tau;
  ivec3 brick; // the last that was looked at, and its entry
  int entry;
};

March begun() {
  return March(0, 0.0, ivec3(-1), 0);
}

vec3 gradientSum = vec3(0);

int entryAt(inout March march, ivec3 brick) {
  if (brick != march.brick) {
    march.brick = brick;
    march.entry = tableAt(brick);
  }
  return march.entry;
}

// The two codes of a half column around z = 0..3, interpolated.
float edge(uvec2 texel, int z, float share) {
  uint low = (texel.x >> (8 * z)) & 255u;
  uint high = z == 3 ? texel.y & 255u : (texel.x >> (8 * z + 8)) & 255u;
  float a = float(low);
  return a + (float(high) - a) * share;
}

ivec3 cellOf(vec3 g) {
  return clamp(ivec3(g), ivec3(0), ivec3(uResolution - 1));
}

// The interpolated code at a place that has a brick; false where the cell is not live.
bool codeAt(int entry, vec3 g, ivec3 cell, out float code, out vec3 slope) {
  int level = entry & 7;
  cell >>= level;
  vec3 share = g * (1.0 / float(1 << level)) - vec3(cell);
  cell &= 7;
  int z = cell.z & 3, at = ((entry >> 3) * 81 + cell.x * 9 + cell.y) * 2 + (cell.z >> 2);
  uvec2 first = densityAt(at);
  if (((first.y >> (8 + z)) & 1u) == 0u) return false;
  uvec2 second = densityAt(at + 2), third = densityAt(at + 18), fourth = densityAt(at + 20);
  float e0 = edge(first, z, share.z), e1 = edge(second, z, share.z);
  float e2 = edge(third, z, share.z), e3 = edge(fourth, z, share.z);
  float f0 = e0 + (e1 - e0) * share.y, f1 = e2 + (e3 - e2) * share.y;
  code = f0 + (f1 - f0) * share.x;
#ifdef NORMALS
  float d0 = edge(first, z, 1.0) - edge(first, z, 0.0), d1 = edge(second, z, 1.0) - edge(second, z, 0.0);
  float d2 = edge(third, z, 1.0) - edge(third, z, 0.0), d3 = edge(fourth, z, 1.0) - edge(fourth, z, 0.0);
  slope = vec3(f1 - f0, mix(e1 - e0, e3 - e2, share.x), mix(mix(d0, d1, share.y), mix(d2, d3, share.y), share.x));
  slope *= 1.0 / float(1 << level);
#endif
  return true;
}

// -expm1(-x)
float alphaOf(float x) {
  return x < 0.03 ? x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0)))) : 1.0 - exp(-x);
}

// Moves on to the next sample that has weight; false where there is none.
bool nextSample(inout March march, out float s, out float weight) {
  for (int guard = 0; guard < MOST_STEPS; guard++) {
    vec3 g = placeOf(march.n, 1);
    if (!(sampleS < rayLength) || march.tau > uMostTau) return false;
    ivec3 cell = cellOf(g);
    int entry = entryAt(march, cell >> 3);
    if (entry < 0) {
      march.n = jumpFrom(march.n, g, cell >> 3, -1 - entry);
      continue;
    }
    int size = uLevelSteps[entry & 7];
    if (march.n != 0) size = min(size, march.n & -march.n);
    if (size > 1) {
      g = placeOf(march.n, size);
      cell = cellOf(g);
      entry = entryAt(march, cell >> 3);
    }
    march.n += size;
    float code;
    vec3 slope;
    if (entry < 0 || !(sampleS < rayLength) || !codeAt(entry, g, cell, code, slope)) continue;
    float optical = exp(uDensityCode.x + uDensityCode.y * code) * wayOf(size);
    s = sampleS;
    weight = exp(-march.tau) * alphaOf(optical);
    march.tau += optical;
    if (weight > 0.0) {
#ifdef NORMALS
      gradientSum -= weight * pulledBack(slope * uCellsPerUnit);
#endif
      return true;
    }
  }
  return false;
}
