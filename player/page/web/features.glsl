// The features around a place, trilinear over the corners that are stored. The twin of `stored_features` in
// player/march/fetches.py. FEATURES, ADD_ROW and CLEAR_FEATURES are written by program.js for the number of channels.

uniform int uFeatureResolution;
uniform float uFeatureScale;

const float MIN_TOTAL = 1e-3;

FEATURES

void addRow(int row, float share) {
  ivec3 at = texelOfRow(row);
  ADD_ROW
}

// Adds the features at a place, in cells of the densities' grid; false where too little is stored.
bool addFeatures(vec3 g, float weight) {
  g = clamp(g * uFeatureScale, vec3(0), vec3(uFeatureResolution));
  vec3 cell = min(floor(g), vec3(uFeatureResolution - 1));
  ivec4 owner = ownerAt(ivec3(cell * 0.125));
  if (owner.y >= 65280) return false; // there is none
  int level = int(float(owner.y) * (1.0 / 256.0)), first = owner.z + owner.w * 65536;
  float scale = 1.0 / float(1 << level);
  vec3 own = floor(cell * scale), share = g * scale - own;
  ivec3 at = ivec3(owner.x & 255, int(float(owner.x) * (1.0 / 256.0)), owner.y & 255) * ivec3(8, 8, 9) + (ivec3(own) & 7);
  ivec4 low = indicesAt(at), high = indicesAt(at + ivec3(0, 0, 1)); // the corners (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1)
  vec4 across = vec4((1.0 - share.x) * (1.0 - share.y), (1.0 - share.x) * share.y, share.x * (1.0 - share.y), share.x * share.y);
  vec4 below = across * (1.0 - share.z) * vec4(greaterThanEqual(low, ivec4(0)));
  vec4 above = across * share.z * vec4(greaterThanEqual(high, ivec4(0)));
  float total = dot(below + above, vec4(1));
  if (total < MIN_TOTAL) return false;
  weight *= 127.0 / total;
  below *= weight;
  above *= weight;
  low = first + max(low, ivec4(0));
  high = first + max(high, ivec4(0));
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
