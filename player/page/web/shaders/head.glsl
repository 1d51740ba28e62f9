// Runs the head for 2 x 2 pixels: turns what the march has found for them into colours, four bytes each. Names in capitals,
// except the constants here, are replaced by texts that head.js and program.js write.

FOUND_INPUTS
uniform highp usampler2D uOpacity;
uniform highp sampler2D uWeights;

layout(location = 0) out uvec4 colours;

// Three vectors for each layer: the numbers of texels of its inputs and outputs, and where these begin in the memory; the
// first texel of its weights, what is done to its outputs, and 1 / scale and zero of their rounding; and whether outputs are
// added to what is there.
uniform vec4 uLayers[3 * N_LAYERS];

const float ACTIVATED = 1.0, ROUNDED = 2.0;

mat4 memory[MEMORY]; // a column for each pixel

vec4 weight(int k) {
  return texelFetch(uWeights, ivec2(k & 1023, int(float(k) * (1.0 / 1024.0))), 0);
}

// Return x (1 + erf(x / sqrt 2)) / 2 to 5e-7, with the error function of Abramowitz and Stegun, 7.1.28.
vec4 gelu(vec4 x) {
  vec4 y = abs(x);
  vec4 q = 1.0 + y * (0.04986734697 + y * (0.02114100615 + y * (0.003277626324 + y * (3.8003575e-5 + y * (4.889063564e-5 + y * 5.382975e-6)))));
  q *= q;
  q *= q;
  q *= q;
  q *= q;
  return max(x, 0.0) - 0.5 * y / q;
}

vec4 hard_swish(vec4 x) {
  return x * clamp(x * (1.0 / 6.0) + 0.5, 0.0, 1.0);
}

vec4 rounded(vec4 x, float perStep, float zero) {
  return clamp(roundEven(x * perStep) + zero, 0.0, 255.0) - zero;
}

mat4 allRounded(mat4 x, float perStep, float zero) {
  return mat4(rounded(x[0], perStep, zero), rounded(x[1], perStep, zero), rounded(x[2], perStep, zero), rounded(x[3], perStep, zero));
}

mat4 activated(mat4 x, vec4 scale, vec4 after) {
  x = mat4(x[0] * scale, x[1] * scale, x[2] * scale, x[3] * scale);
  if (after.y < ACTIVATED) return x;
  x = mat4(ACTIVATION(x[0]), ACTIVATION(x[1]), ACTIVATION(x[2]), ACTIVATION(x[3]));
  return after.y < ROUNDED ? x : allRounded(x, after.z, after.w);
}

mat4 weights(int k) {
  return mat4(weight(k), weight(k + 1), weight(k + 2), weight(k + 3));
}

vec4 unpackedPair(uint low, uint high) {
  return vec4(unpackSnorm2x16(low), unpackSnorm2x16(high));
}

void runLayer(vec4 sizes, vec4 after, bool add) {
  int k = int(after.x), x = int(sizes.z), end = x + int(sizes.x), y = int(sizes.w), last = y + int(sizes.y);
  for (; y < last; y += 2) {
    vec4 bias = weight(k), nextBias = weight(k + 1), scale = weight(k + 2), nextScale = weight(k + 3);
    mat4 sum = add ? memory[y] : mat4(bias, bias, bias, bias), nextSum = add ? memory[y + 1] : mat4(nextBias, nextBias, nextBias, nextBias);
    k += 4;
    for (int i = x; i < end; i++) {
      mat4 inputs = memory[i];
      sum += weights(k) * inputs;
      nextSum += weights(k + 4) * inputs;
      k += 8;
    }
    memory[y] = activated(sum, scale, after);
    memory[y + 1] = activated(nextSum, nextScale, after);
  }
}

void main() {
  ivec2 first = ivec2(gl_FragCoord.xy) * 2;
  colours = uvec4(0);
  bool some = false;
  for (int p = 0; p < 4; p++) some = some || texelFetch(uOpacity, first + ivec2(p & 1, p >> 1), 0).y != 0u;
  if (!some) return;
  for (int p = 0; p < 4; p++) {
    ivec2 at = first + ivec2(p & 1, p >> 1);
    vec3 direction = directionOf(vec2(at) + 0.5);
    float scale = uintBitsToFloat(texelFetch(uOpacity, at, 0).y); // undoes the shares of pixel.glsl
    READ_FEATURES
    WRITE_MONOMIALS
  }
  for (int layer = 0; layer < N_LAYERS; layer++) {
    runLayer(uLayers[3 * layer], uLayers[3 * layer + 1], uLayers[3 * layer + 2].x > 0.0);
    if (layer != HARMONICS_LAYER) continue;
    MULTIPLY_BY_HARMONICS
  }
  uvec4 found;
  for (int p = 0; p < 4; p++) {
    vec3 rgb = 1.0 / (1.0 + exp(-memory[COLOURS_AT][p].xyz));
    uvec3 levels = uvec3(clamp(rgb, 0.0, 1.0) * 1023.0 + 0.5);
    found[p] = levels.x | (levels.y << 10) | (levels.z << 20);
  }
  colours = found;
}
