// Long arrays lie in layered textures, row by row: WIDTH_BITS are the bits of a texel's column, uBits those of its row in
// a layer, for densities, columns and features.

uniform highp isampler3D uTable;
uniform highp usampler2DArray uDensity;
uniform highp isampler3D uOwners;
uniform highp usampler2DArray uColumns;
uniform highp usampler2DArray uFeatures;
uniform int uBits[3];

uint nTexels = 0u;

#ifdef COUNTING
#define COUNT nTexels++
#else
#define COUNT
#endif

ivec3 texelOf(int i, int rowBits) {
  return ivec3(i & ((1 << WIDTH_BITS) - 1), (i >> WIDTH_BITS) & ((1 << rowBits) - 1), i >> (WIDTH_BITS + rowBits));
}

int tableAt(ivec3 brick) {
  COUNT;
  return texelFetch(uTable, brick.zyx, 0).r;
}

int ownerAt(ivec3 brick) {
  COUNT;
  return texelFetch(uOwners, brick.zyx, 0).r;
}

uvec2 densityAt(int i) {
  COUNT;
  return texelFetch(uDensity, texelOf(i, uBits[0]), 0).rg;
}

uvec2 columnAt(int i) {
  COUNT;
  return texelFetch(uColumns, texelOf(i, uBits[1]), 0).rg;
}

uvec4 featureTexel(int i) {
  COUNT;
  return texelFetch(uFeatures, texelOf(i, uBits[2]), 0);
}
