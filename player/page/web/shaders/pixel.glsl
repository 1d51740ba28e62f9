// Draws a layer of a pixel: marches its ray and writes what the layer shows. For the colour it writes what the head needs,
// two features a word, as shares of the largest of the pixel. FOUND_OUTPUTS, CLEAR_FEATURES, LARGEST_FEATURES and WRITE_FOUND
// are replaced by code that program.js writes.

uniform vec3 uOrigin;
uniform float uScale;
uniform vec2 uDepths;
uniform mat3 uWorldFromModel;

const float MIN_OPACITY = 1.0 / 512.0;

#if LAYER == 0 && !defined(COUNTING)
FOUND_OUTPUTS
#else
out vec4 picture;
#endif

// Return a colour for x from 0 to 1: dark purple to yellow, rising in lightness.
vec3 coloured(float x) {
  x = clamp(x, 0.0, 1.0) * 4.0;
  vec3 a = mix(vec3(68, 1, 84), vec3(59, 82, 139), min(x, 1.0));
  a = mix(a, vec3(33, 145, 140), clamp(x - 1.0, 0.0, 1.0));
  a = mix(a, vec3(94, 201, 98), clamp(x - 2.0, 0.0, 1.0));
  return mix(a, vec3(253, 231, 37), clamp(x - 3.0, 0.0, 1.0)) / 255.0;
}

vec4 bytesOf(uint bits) {
  return vec4((uvec4(bits) >> uvec4(0, 8, 16, 24)) & 255u) / 255.0;
}

void main() {
  vec3 direction = directionOf(gl_FragCoord.xy);
  enter(uOrigin + uStart * turnedBy, direction);

  March march = begun();
  keepSamples(march);
  float opacity = alphaOf(march.tau);
  bool hit = opacity > MIN_OPACITY && nWeights > 0;
  float depth = nWeights > 0 ? uScale * (uStart + distanceAt(moment / total)) : 0.0;
#if LAYER == 0
  CLEAR_FEATURES
  if (hit) fetchFeatures(opacity);
#ifndef COUNTING
  vec4 largest = LARGEST_FEATURES;
  float most = max(max(max(largest.x, largest.y), max(largest.z, largest.w)), 1e-20), share = 1.0 / most;
  WRITE_FOUND
  foundOpacity = uvec4(floatBitsToUint(opacity), hit ? floatBitsToUint(most) : 0u, 0u, 0u);
#endif
#elif LAYER == 1
  float spread = (depth - uDepths.x) / max(uDepths.y - uDepths.x, 1e-12);
  picture = vec4(opacity > 0.5 ? coloured(1.0 - spread) : vec3(0), 1.0);
#elif LAYER == 2
  float steep = length(gradientSum);
  vec3 normal = steep > 1e-9 ? uWorldFromModel * (gradientSum / steep) : vec3(0);
  picture = vec4(opacity > 0.5 ? normal * 0.5 + 0.5 : vec3(0), 1.0);
#elif LAYER == 3
  picture = vec4(vec3(opacity), 1.0);
#elif LAYER == 4
  picture = bytesOf(hit ? floatBitsToUint(uScale * (uStart + distanceAt(middlePlace()))) : 0u);
#endif
#ifdef COUNTING
  picture = bytesOf(nTexels | (hit ? 1u << 24 : 0u));
#endif
}
