// The features around a place, trilinear over the corners that are stored. The twin of `stored_features` in
// player/march/fetches.py. FEATURES, ADD_ROW and CLEAR_FEATURES are written by program.js for the number of channels.

uniform int uFeatureResolution;
uniform float uFeatureScale;

const float MIN_TOTAL = 1e-3;

FEATURES

vec4 unpacked(uint word) {
  return vec4((ivec4(uvec4(word)) << ivec4(24, 16, 8, 0)) >> 24);
}

void addRow(int row, float share) {
  ADD_ROW
}

// How many of the eight vertices of a column with bits in `mask` are stored before vertex z.
int storedBefore(uint mask, int z) {
  uint bits = mask & ((1u << z) - 1u) & 255u;
  bits = (bits & 0x55u) + ((bits >> 1) & 0x55u);
  bits = (bits & 0x33u) + ((bits >> 2) & 0x33u);
  return int((bits + (bits >> 4)) & 15u);
}

float shareOf(uvec2 column, int z, float share) {
  uvec2 bits = (uvec2(column.y) >> uvec2(z, z + 1)) & 1u;
  return (1.0 - share) * float(bits.x) + share * float(bits.y);
}

void addColumn(uvec2 column, int z, float share, float weight) {
  uvec2 bits = (uvec2(column.y) >> uvec2(z, z + 1)) & 1u;
  int row = int(column.x) + storedBefore(column.y, z);
  if (bits.x == 1u) addRow(row, weight * (1.0 - share));
  int above = z == 7 ? int(column.x) + int(column.y >> 9) : row + int(bits.x);
  if (bits.y == 1u) addRow(above, weight * share);
}

// Adds the features at a place, in cells of the densities' grid; false where too little is stored.
bool addFeatures(vec3 g, float weight) {
  g = clamp(g * uFeatureScale, vec3(0), vec3(uFeatureResolution));
  ivec3 low = min(ivec3(g), ivec3(uFeatureResolution - 1));
  int held = ownerAt(low >> 3);
  if (held < 0) return false;
  int level = held & 7;
  low >>= level;
  vec3 share = g * (1.0 / float(1 << level)) - vec3(low);
  low &= 7;
  int at = (held >> 3) * 81 + low.x * 9 + low.y;
  uvec2 c0 = columnAt(at), c1 = columnAt(at + 1), c2 = columnAt(at + 9), c3 = columnAt(at + 10);
  vec4 across = vec4((1.0 - share.x) * (1.0 - share.y), (1.0 - share.x) * share.y, share.x * (1.0 - share.y), share.x * share.y);
  float total = across.x * shareOf(c0, low.z, share.z) + across.y * shareOf(c1, low.z, share.z)
    + across.z * shareOf(c2, low.z, share.z) + across.w * shareOf(c3, low.z, share.z);
  if (total < MIN_TOTAL) return false;
  across *= weight / total;
  addColumn(c0, low.z, share.z, across.x);
  addColumn(c1, low.z, share.z, across.y);
  addColumn(c2, low.z, share.z, across.z);
  addColumn(c3, low.z, share.z, across.w);
  return true;
}
