// The head of 2 x 2 pixels: what the march has found for them becomes their colours, four bytes each. HEAD_CODE and
// N_FEATURES are written by head.js and program.js.

FOUND_INPUTS
uniform highp usampler2D uOpacity;
uniform highp sampler2D uWeights;

layout(location = 0) out uvec4 colours;

vec3 rgb[4];

vec4 weight(int k) {
  return texelFetch(uWeights, ivec2(k & 1023, int(float(k) * (1.0 / 1024.0))), 0);
}

// x (1 + erf(x / sqrt 2)) / 2, with the error function of Abramowitz and Stegun, 7.1.28: to 5e-7.
vec4 gelu(vec4 x) {
  vec4 y = abs(x);
  vec4 q = 1.0 + y * (0.04986734697 + y * (0.02114100615 + y * (0.003277626324 + y * (3.8003575e-5 + y * (4.889063564e-5 + y * 5.382975e-6)))));
  q *= q;
  q *= q;
  q *= q;
  q *= q;
  return max(x, 0.0) - 0.5 * y / q;
}

vec4 rounded(vec4 x, float perStep, float zero) {
  return clamp(roundEven(x * perStep) + zero, 0.0, 255.0) - zero;
}

vec4 unpackedPair(uint low, uint high) {
  return vec4(unpackSnorm2x16(low), unpackSnorm2x16(high)) * 128.0;
}

void headOf(vec3 direction[4], vec4 f0[N_FEATURES], vec4 f1[N_FEATURES], vec4 f2[N_FEATURES], vec4 f3[N_FEATURES]) {
HEAD_CODE
}

void readFeatures(ivec2 at, out vec4 f[N_FEATURES]) {
READ_FEATURES
}

void main() {
  ivec2 first = ivec2(gl_FragCoord.xy) * 2;
  colours = uvec4(0);
  vec3 direction[4];
  bool some = false;
  for (int p = 0; p < 4; p++) {
    ivec2 at = first + ivec2(p & 1, p >> 1);
    direction[p] = directionOf(vec2(at) + 0.5).xyz;
    some = some || texelFetch(uOpacity, at, 0).y != 0u;
  }
  if (!some) return;
  vec4 f0[N_FEATURES], f1[N_FEATURES], f2[N_FEATURES], f3[N_FEATURES];
  readFeatures(first, f0);
  readFeatures(first + ivec2(1, 0), f1);
  readFeatures(first + ivec2(0, 1), f2);
  readFeatures(first + ivec2(1, 1), f3);
  headOf(direction, f0, f1, f2, f3);
  uvec4 found;
  for (int p = 0; p < 4; p++) {
    uvec3 levels = uvec3(clamp(rgb[p], 0.0, 1.0) * 1023.0 + 0.5);
    found[p] = levels.x | (levels.y << 10) | (levels.z << 20);
  }
  colours = found;
}
