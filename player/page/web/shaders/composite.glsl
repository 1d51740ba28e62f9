// Draws the colours of a tile over the background.

uniform highp usampler2D uColours, uOpacity;
uniform vec4 uBackground; // alpha 0 if the background is transparent
uniform vec2 uTile;
uniform bool uPremultiplied;

out vec4 picture;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy - uTile);
  uvec2 found = texelFetch(uOpacity, at, 0).xy;
  float opacity = uintBitsToFloat(found.x);
  uint bits = texelFetch(uColours, at >> 1, 0)[(at.x & 1) + 2 * (at.y & 1)];
  vec3 rgb = found.y == 0u ? vec3(0) : vec3((uvec3(bits) >> uvec3(0, 10, 20)) & 1023u) / 1023.0;
  if (uBackground.a > 0.0) picture = vec4(rgb * opacity + (1.0 - opacity) * uBackground.rgb, 1.0);
  else picture = vec4(uPremultiplied ? rgb * opacity : rgb, opacity);
}
