// Fragment shader that marches one ray a pixel (paper, section 5.2), with the same samples as core/rendering/render.py: at
// t_entry + 0.5 + k voxels along the ray, k = 0, 1, 2, ... Empty-space skipping only increases k, and only past samples that are
// zero, so the image equals that of a march without skipping.
//
// Rays look for their next sample in one loop and read it behind it: a group of pixels, which a GPU and a software rasteriser process
// together, then reads the atlas as often as the ray with the most samples, and not whenever any of the rays has one.
precision highp float;
precision highp int;
precision highp sampler3D;
precision highp isampler3D;
precision highp usampler3D;

#define VIEW_DEPENDENCE {{VIEW_DEPENDENCE}}
#define OPACITY_CORRECTION {{OPACITY_CORRECTION}}
#define FORWARD_FACING {{FORWARD_FACING}}
#define SCENE_DEPTH {{SCENE_DEPTH}}
#define PICKING {{PICKING}} // give the depth at which half of the light is gone in place of a colour

const float DATA_VOXELS = {{DATA_VOXELS}}; // voxels of a macroblock along an axis
const float CELL_VOXELS = {{CELL_VOXELS}}; // the same with the apron, as stored in the atlas
const float NETWORK_TRANSMITTANCE = {{NETWORK_TRANSMITTANCE}}; // the network is evaluated where no more than this is left
const float MIN_TRANSMITTANCE = 1.0 / 1024.0; // a ray ends here: what lies behind changes no 8-bit value by more than a quarter
const float STEP_EPSILON = 1e-3; // steps by which rounding may misplace an exit; a jump ends early by this much, never late

// Rays are given in "ray space": the grid in voxels; in a forward-facing scene the frame in units of its near plane's distance.
uniform vec2 focal;               // pixels of this image; of an orthographic camera, pixels a unit
uniform vec2 principalPoint;      // pixels from the top left corner
uniform vec3 viewport;            // pixels: left, bottom and height
uniform bool orthographic;
uniform vec3 cameraPosition;      // ray space
uniform mat3 raySpaceFromCamera;  // a rotation
uniform mat3 networkFromCamera;   // a rotation, to the axes in which the network was trained
uniform float nearDistance;       // ray space, along the ray, where the scene begins
uniform vec2 clipPlanes;          // ray space, along the view axis: nearest and farthest that is seen
uniform vec3 gridShape;           // voxels
uniform vec3 gridBlocks;          // macroblocks
uniform bool linearOutput;        // whether the image holds linear colours in place of sRGB
uniform isampler3D indirection;
uniform vec3 texelSize;           // of an atlas page, in texture coordinates
#if SCENE_DEPTH
// What is drawn already. A depth in ray space, along the view axis, is to and from the depth buffer as depthTerms say: of a perspective
// camera x / depth - y, of an orthographic one x - y * depth, and then * z + w.
uniform highp sampler2D sceneDepth;
uniform vec4 depthTerms;
uniform vec2 logDepth; // of a logarithmic depth buffer of a perspective camera: world units of ray space, and 1 / log2(far + 1); else 0
#endif

out vec4 colour;

{{ATLAS_LOOKUPS}}
{{NETWORK}}
{{NDC}}
#if SCENE_DEPTH
float bufferFromView(float depth) {
  if (logDepth.y > 0.0) return log2(1.0 + depth * logDepth.x) * logDepth.y;
  return (orthographic ? depthTerms.x - depthTerms.y * depth : depthTerms.x / depth - depthTerms.y) * depthTerms.z + depthTerms.w;
}

float viewFromBuffer(float value) {
  if (logDepth.y > 0.0) return (exp2(value / logDepth.y) - 1.0) / logDepth.x;
  float ndc = (value - depthTerms.w) / depthTerms.z;
  return orthographic ? (depthTerms.x - ndc) / depthTerms.y : depthTerms.x / (ndc + depthTerms.y);
}
#endif

float least(vec3 values) {
  return min(values.x, min(values.y, values.z));
}

// The first sample at or behind a distance from the ray's entry: its own distance.
float firstSampleFrom(float distance) {
  return ceil(distance - 0.5 - STEP_EPSILON) + 0.5;
}

// sRGB to linear (IEC 61966-2-1).
vec3 linear(vec3 srgb) {
  return mix(srgb / 12.92, pow((srgb + 0.055) / 1.055, vec3(2.4)), greaterThan(srgb, vec3(0.04045)));
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x - viewport.x, viewport.z + viewport.y - gl_FragCoord.y);
  vec2 imagePlane = vec2(pixel.x - principalPoint.x, principalPoint.y - pixel.y) / focal;
  vec3 viewDirection = orthographic ? vec3(0.0, 0.0, -1.0) : normalize(vec3(imagePlane, -1.0)); // camera axes
  vec3 origin = orthographic ? cameraPosition + raySpaceFromCamera * vec3(imagePlane, 0.0) : cameraPosition;
  vec3 direction = raySpaceFromCamera * viewDirection;
  float near = max(nearDistance, clipPlanes.x / -viewDirection.z);
  float far = clipPlanes.y / -viewDirection.z;
#if SCENE_DEPTH
  float drawn = texelFetch(sceneDepth, ivec2(gl_FragCoord.xy), 0).r;
  far = min(far, viewFromBuffer(drawn) / -viewDirection.z);
#endif
#if SCENE_DEPTH || PICKING
  vec3 camera = origin;
#endif
#if FORWARD_FACING
  toGrid(origin, direction, near, far);
#endif
  vec3 inverseDirection = 1.0 / mix(direction, vec3(1e-9), lessThan(abs(direction), vec3(1e-9)));

  vec3 low = min(-origin * inverseDirection, (gridShape - origin) * inverseDirection);
  vec3 high = max(-origin * inverseDirection, (gridShape - origin) * inverseDirection);
  float entryDistance = max(-least(-low), near);
  float endDistance = min(far, least(high));

  vec3 rgb = vec3(0.0);
  vec4 features = vec4(0.0);
  float transmittance = 1.0;
  vec3 entry = origin + direction * entryDistance;
  float end = endDistance - entryDistance;
  float t = 0.5; // of the sample: voxels from the entry
  float blockEnd = 0.0; // where the macroblock ends: no sample before it lies outside
  int page = 0;
  vec3 atlasEntry = vec3(0.0); // the entry in the macroblock's cell: texels of the page, half a texel down, which numbers stencils
  float stencilSteps = least(abs(inverseDirection)); // to cross a stencil, at least
  vec3 side = sign(inverseDirection); // of a box, at which the ray leaves it: -1 or 1
  vec3 ahead = max(side, 0.0);
#if SCENE_DEPTH || PICKING
  float halfway = -1.0; // the sample at which half of the light is gone
#endif
  bool maybeEmpty = true; // whether the stencil at t may be empty
  do { // the loops end with conditions, because a software rasteriser runs the body of any loop at least once
    do { // look for a macroblock that is not empty
      if (t >= blockEnd) {
        // Clamp: rounding may put a sample on the grid's outer face into a block outside.
        vec3 block = clamp(floor((entry + t * direction) * (1.0 / DATA_VOXELS)), vec3(0.0), gridBlocks - 1.0);
        int cell = texelFetch(indirection, ivec3(block), 0).r;
        vec3 radius = vec3(max(-cell - 1, 0)); // an empty macroblock holds minus the distance in blocks to the nearest that is not
        vec3 exits = ((block + ahead + side * radius) * DATA_VOXELS - entry) * inverseDirection;
        float next = max(t + 1.0, firstSampleFrom(least(exits)));
        if (cell < 0) {
          t = next;
        } else {
          blockEnd = min(next, end);
          page = cell >> 24;
          atlasEntry = entry + vec3(cell & 255, cell >> 8 & 255, cell >> 16 & 255) * CELL_VOXELS + 0.5 - block * DATA_VOXELS;
          maybeEmpty = true;
        }
      }
    } while (t >= blockEnd && t < end);
    do { // in it, look for a stencil that is not empty
      if (maybeEmpty && t < blockEnd) {
        float distance = distanceAt(page, ivec3(atlasEntry + t * direction));
        maybeEmpty = distance > 0.0;
        // All stencils less than the distance away along every axis are empty; distances hold within the macroblock only.
        if (maybeEmpty) t = min(t + floor((distance - 1.0) * stencilSteps) + 1.0, blockEnd);
      }
    } while (maybeEmpty && t < blockEnd);
    if (t < blockEnd) {
      vec3 place = (atlasEntry + t * direction + 0.5) * texelSize;
      vec4 rgba = rgbaAt(page, place);
      rgb += transmittance * rgba.rgb;
#if VIEW_DEPENDENCE
      features += transmittance * featureAt(page, place);
#endif
      transmittance *= 1.0 - rgba.a;
#if SCENE_DEPTH || PICKING
      if (halfway < 0.0 && transmittance < 0.5) halfway = t;
#endif
      maybeEmpty = rgba.a == 0.0;
      t += 1.0;
    }
  } while (t < end && transmittance > MIN_TRANSMITTANCE);

#if OPACITY_CORRECTION
  // Equation 9 divides by alpha; the limit of 1.5 keeps it finite at alpha 0.
  float alpha = 1.0 - transmittance;
  float factor = alpha < 2.0 / 3.0 ? 1.5 : 1.0 / alpha;
  rgb *= factor;
  features *= factor;
  transmittance = max(1.0 - factor * alpha, 0.0);
#endif
#if VIEW_DEPENDENCE
  if (transmittance <= NETWORK_TRANSMITTANCE) rgb += viewDependentColour(rgb + transmittance, features, networkFromCamera * viewDirection);
#endif
  colour = vec4(clamp(rgb, 0.0, 1.0), 1.0 - transmittance); // premultiplied
#if SCENE_DEPTH || PICKING
  float viewDepth = 0.0; // ray space, along the view axis; 0 where half of the light comes through
  if (halfway >= 0.0) {
    vec3 point = entry + halfway * direction;
#if FORWARD_FACING
    point = fromGrid(point);
#endif
    viewDepth = dot(point - camera, raySpaceFromCamera * vec3(0.0, 0.0, -1.0));
  }
#endif
#if SCENE_DEPTH
  gl_FragDepth = halfway >= 0.0 ? bufferFromView(viewDepth) : drawn;
#endif
  if (linearOutput && colour.a > 0.0) colour.rgb = colour.a * linear(min(colour.rgb / colour.a, 1.0));
#if PICKING
  colour = vec4(uvec4(floatBitsToUint(viewDepth)) >> uvec4(0, 8, 16, 24) & 255u) / 255.0;
#endif
}
