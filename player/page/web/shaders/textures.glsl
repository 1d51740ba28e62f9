// Reads the textures of the grids: see grid.js. Places are computed by products and differences instead of shifts, which
// cost as much as fetches where the shader runs on a CPU.

uniform highp usampler3D uTable;
uniform highp sampler3D uDensity;
uniform highp usampler3D uOwners;
uniform highp usampler3D uColumns;
uniform highp sampler2DArray uFeatures;

uint nTexels = 0u;

#ifdef COUNTING
#define COUNT nTexels++
#else
#define COUNT
#endif

ivec4 tableAt(ivec3 brick) {
  COUNT;
  return ivec4(texelFetch(uTable, brick.zyx, 0));
}

vec4 densityAt(ivec3 at) {
  COUNT;
  return texelFetch(uDensity, at, 0);
}

ivec4 ownerAt(ivec3 brick) {
  COUNT;
  return ivec4(texelFetch(uOwners, brick.zyx, 0));
}

uvec4 columnsAt(ivec3 at) {
  COUNT;
  return texelFetch(uColumns, at, 0);
}

// Return the position of the first texel of a row of features.
ivec3 texelOfRow(int row) {
  int line = int(float(row) * (1.0 / float(ROWS_A_LINE))), layer = int(float(line) * (1.0 / float(LINES_A_LAYER)));
  return ivec3((row & (ROWS_A_LINE - 1)) * WORDS, line & (LINES_A_LAYER - 1), layer);
}

vec4 featureAt(ivec3 at) {
  COUNT;
  return texelFetch(uFeatures, at, 0);
}
