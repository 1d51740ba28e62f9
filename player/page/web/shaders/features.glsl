// Interpolates the features at a point, trilinearly over the corners that are stored. The twin of `stored_features` in
// player/march/fetches.py. FEATURES and ADD_ROW are replaced by code that program.js writes for the number of channels.

uniform int uFeatureResolution;
uniform float uFeatureScale;

const float MIN_TOTAL = 1e-3;

FEATURES

void addRow(int row, float share) {
  ivec3 at = texelOfRow(row);
  ADD_ROW
}

// Return how many of the lowest eight bits of each component are set.
ivec4 nSet(uvec4 bits) {
  bits -= (bits >> 1) & 0x55u;
  bits = (bits & 0x33u) + ((bits >> 2) & 0x33u);
  return ivec4((bits + (bits >> 4)) & 15u);
}

// Add `weight` times the features at g, in cells of the densities' grid. Returns false where too little is stored.
bool addFeatures(vec3 g, float weight) {
  g = clamp(g * uFeatureScale, vec3(0), vec3(uFeatureResolution));
  vec3 cell = min(floor(g), vec3(uFeatureResolution - 1));
  ivec4 owner = ownerAt(ivec3(cell * 0.125));
  if (owner.w == NO_LEVEL) return false;
  float scale = 1.0 / float(1 << owner.w);
  vec3 own = floor(cell * scale), share = g * scale - own;
  ivec3 local = ivec3(own) & 7, at = owner.xyz * ivec3(9, 8, 1) + ivec3(local.xy, 0);
  uvec4 near = columnsAt(at), far = columnsAt(at + ivec3(1, 0, 0));
  uvec4 column = uvec4(near.xz, far.xz); // of the corners (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1)
  uint bit = 1u << local.z;
  ivec4 low = ivec4(column >> 8) + nSet(column & (bit - 1u)), high;
  bvec4 isLow = notEqual(column & bit, uvec4(0)), isHigh;
  if (local.z < 7) {
    isHigh = notEqual(column & (bit << 1), uvec4(0));
    high = low + ivec4(isLow);
  } else {
    uvec4 next = uvec4(near.yw, far.yw);
    isHigh = notEqual(next & 1u, uvec4(0));
    high = ivec4(next >> 8);
  }
  vec4 across = vec4((1.0 - share.x) * (1.0 - share.y), (1.0 - share.x) * share.y, share.x * (1.0 - share.y), share.x * share.y);
  vec4 below = across * (1.0 - share.z) * vec4(isLow);
  vec4 above = across * share.z * vec4(isHigh);
  float total = dot(below + above, vec4(1));
  if (total < MIN_TOTAL) return false;
  weight *= 127.0 / total;
  below *= weight;
  above *= weight;
  addRow(low.x, below.x);
  addRow(low.y, below.y);
  addRow(low.z, below.z);
  addRow(low.w, below.w);
  addRow(high.x, above.x);
  addRow(high.y, above.y);
  addRow(high.z, above.z);
  addRow(high.w, above.w);
  return true;
}
