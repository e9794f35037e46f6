// The march (paper, section 5.2), the same as core/rendering/render.py: one lattice of samples a ray, t_start + 0.5 + k voxels.
// Skipping only ever moves to a later k, and only past what is zero, so the picture is that of a march without it.
precision highp float;
precision highp int;
precision highp sampler3D;
precision highp isampler3D;

const float STOP = 1.0 / 1024.0; // the transmittance at which a ray ends
const float EARLY = 1e-3;        // of a step: a jump may end a hair early, never late

// Rays are given in voxels along the grid's axes; in a forward-facing scene along its frame's axes, in units of its near plane.
uniform vec2 focal;          // pixels of this picture (parallel rays: pixels a unit)
uniform vec2 centre;         // pixels from the top left corner
uniform float height;        // pixels
uniform bool parallel;       // an orthographic camera
uniform vec3 eye;
uniform mat3 axesFromCamera; // a rotation
uniform mat3 viewFromCamera; // to the axes in which the network was trained
uniform float near;          // units from the eye
uniform vec3 shape;          // voxels
uniform ivec3 blocks;
uniform vec3 background;
uniform isampler3D indirection;

out vec4 colour;

// How far along the ray it leaves the box between two corners; `from` lies in it.
float leaves(vec3 from, vec3 inverse, vec3 low, vec3 high) {
  vec3 far = (mix(low, high, greaterThan(inverse, vec3(0.0))) - from) * inverse;
  return min(far.x, min(far.y, far.z));
}

int stepAt(float distance) {
  return int(ceil(min(distance, 1e7) - 0.5 - EARLY));
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, height - gl_FragCoord.y);
  vec2 plane = vec2(pixel.x - centre.x, centre.y - pixel.y) / focal;
  vec3 towards = parallel ? vec3(0.0, 0.0, -1.0) : normalize(vec3(plane, -1.0));
  vec3 origin = parallel ? eye + axesFromCamera * vec3(plane, 0.0) : eye;
  vec3 direction = axesFromCamera * towards;
  float begin = near;
#ifdef NDC
  toGrid(origin, direction, begin);
#endif
  vec3 inverse = 1.0 / mix(direction, vec3(1e-9), lessThan(abs(direction), vec3(1e-9)));

  vec3 low = min(-origin * inverse, (shape - origin) * inverse);
  vec3 high = max(-origin * inverse, (shape - origin) * inverse);
  float start = max(max(low.x, max(low.y, low.z)), begin);
  float stop = min(high.x, min(high.y, high.z));

  vec3 rgb = vec3(0.0);
  vec4 features = vec4(0.0);
  float through = 1.0;
  vec3 entry = origin + direction * start;
  int samples = stop > start ? int(ceil(stop - start - 0.5)) : 0;
  int k = 0;
  while (k < samples && through > STOP) {
    vec3 point = entry + (float(k) + 0.5) * direction;
    // The outer faces belong to the grid: rounding must not push a sample out of its block.
    ivec3 block = clamp(ivec3(floor(point / DATA_VOXELS)), ivec3(0), blocks - 1);
    int cell = texelFetch(indirection, block, 0).r;
    if (cell < 0) {
      vec3 reach = vec3(-cell - 1);
      vec3 corner = vec3(block);
      k = max(k + 1, stepAt(leaves(entry, inverse, (corner - reach) * DATA_VOXELS, (corner + 1.0 + reach) * DATA_VOXELS)));
      continue;
    }
    int page = cell >> 24;
    vec3 corner = vec3(block) * DATA_VOXELS;
    vec3 offset = vec3(cell & 255, cell >> 8 & 255, cell >> 16 & 255) * CELL_VOXELS + 1.0 - corner; // grid to atlas
    int last = min(samples, max(k + 1, stepAt(leaves(entry, inverse, corner, corner + DATA_VOXELS))));
    bool ask = true; // whether the coarse voxel may be empty
    while (k < last && through > STOP) {
      vec3 at = entry + (float(k) + 0.5) * direction + offset;
      if (ask) {
        ivec3 coarse = ivec3(at) >> 2;
        float empty = skipAt(page, coarse);
        if (empty > 0.0) {
          vec3 nearest = (vec3(coarse) + 1.0 - empty) * 4.0;
          float exit = leaves(entry, inverse, nearest - offset, nearest + (2.0 * empty - 1.0) * 4.0 - offset);
          k = min(max(k + 1, stepAt(exit)), last); // past its own border a cell knows nothing
          continue;
        }
      }
      vec4 texel = rgbaAt(page, at);
      rgb += through * texel.rgb;
#ifdef VIEW_DEPENDENCE
      features += through * featureAt(page, at);
#endif
      through *= 1.0 - texel.a;
      ask = texel.a == 0.0;
      ++k;
    }
  }

#ifdef FILL_HOLES
  float alpha = 1.0 - through; // equation 9, finite at alpha 0
  float factor = alpha < 2.0 / 3.0 ? 1.5 : 1.0 / alpha;
  rgb *= factor;
  features *= factor;
  through = max(1.0 - factor * alpha, 0.0);
#endif
#ifdef VIEW_DEPENDENCE
  if (through <= NETWORK_TRANSMITTANCE) rgb += residual(rgb + through, features, viewFromCamera * towards);
#endif
  colour = vec4(clamp(rgb + through * background, 0.0, 1.0), 1.0);
}
