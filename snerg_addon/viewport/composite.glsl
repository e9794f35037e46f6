// The marched picture into the viewport: colour where it is not hidden, and the depth at half transmittance.

vec3 linear(vec3 srgb)  // IEC 61966-2-1: the viewport's framebuffer takes linear values and encodes them itself
{
  vec3 low = srgb / 12.92;
  vec3 high = pow((max(srgb, vec3(0.04045)) + 0.055) / 1.055, vec3(2.4));
  return mix(high, low, vec3(lessThanEqual(srgb, vec3(0.04045))));
}

void main()
{
  vec2 uv = 0.5 * ndc + 0.5;
  vec4 marched = texture(picture, uv);
  float z = -texture(depths, uv).r;
  if (marched.a <= 0.0) {
    discard;
  }
  // The depth along the view axis through the projection: (P22, P23, P32, P33) of its matrix.
  float clip = (projection.x * z + projection.y) / (projection.z * z + projection.w);
  gl_FragDepth = clamp(0.5 * clip + 0.5, 0.0, 1.0);
  colour = vec4(seen * linear(clamp(marched.rgb / marched.a, 0.0, 1.0)) * marched.a, marched.a);
}
