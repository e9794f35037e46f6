// The ray march of rendering/render.py on the graphics card (paper, section 5.2): samples lie at t_start + 0.5 + k voxels, k whole, and
// skipping only ever moves to a later k past voxels that are zero, so that the picture is that of a march without skipping.
// Rays are in voxels along the grid's axes. Writes premultiplied colour, and the ray's depth at half transmittance.

const float STOP = 1.0 / 1024.0;  // the transmittance at which a ray ends
const float EARLY = 1e-3;         // of a step: a jump may end a little early, never late
const float NO_DEPTH = -1.0;

// How far along the ray it leaves the box between two corners; `from` lies in it.
float exit_distance(vec3 from, vec3 inverse_direction, vec3 low, vec3 high)
{
  vec3 face = vec3(inverse_direction.x > 0.0 ? high.x : low.x,
                   inverse_direction.y > 0.0 ? high.y : low.y,
                   inverse_direction.z > 0.0 ? high.z : low.z);
  vec3 reached = (face - from) * inverse_direction;
  return min(reached.x, min(reached.y, reached.z));
}

int step_at(float distance)
{
  return int(ceil(min(distance, 1e7) - 0.5 - EARLY));
}

void main()
{
  vec2 plane = ndc * view.plane_scale.xy + view.plane_scale.zw;
  bool parallel = view.eye.w > 0.5;
  vec3 towards = parallel ? vec3(0.0, 0.0, -1.0) : normalize(vec3(plane, -1.0));
  mat3 axes = mat3(view.axes[0].xyz, view.axes[1].xyz, view.axes[2].xyz);
  vec3 origin = parallel ? view.eye.xyz + axes * vec3(plane, 0.0) : view.eye.xyz;
  vec3 direction = axes * towards;
  direction /= max(length(direction), 1e-20);
  // Blender clips at planes: the distance along the ray is longer towards the picture's edge.
  float begin = max(view.near.x / -towards.z, view.near.z);
  float end = view.near.y / -towards.z;
  vec3 bounded = vec3(abs(direction.x) < 1e-9 ? 1e-9 : direction.x,
                      abs(direction.y) < 1e-9 ? 1e-9 : direction.y,
                      abs(direction.z) < 1e-9 ? 1e-9 : direction.z);
  vec3 inverse_direction = 1.0 / bounded;
  vec3 shape = view.shape.xyz;
  ivec3 blocks = ivec3(view.blocks.xyz);

  vec3 low = min(-origin * inverse_direction, (shape - origin) * inverse_direction);
  vec3 high = max(-origin * inverse_direction, (shape - origin) * inverse_direction);
  float start = max(max(low.x, max(low.y, low.z)), begin);
  float stop = min(min(high.x, min(high.y, high.z)), end);

  vec3 rgb = vec3(0.0);
  vec4 features = vec4(0.0);
  float transmittance = 1.0;
  float half_depth = NO_DEPTH;
  vec3 entry = origin + direction * start;
  int samples = stop > start ? int(ceil(stop - start - 0.5)) : 0;
  int k = 0;
  while (k < samples && transmittance > STOP) {
    vec3 point = entry + (float(k) + 0.5) * direction;
    // The outer faces belong to the grid: rounding must not push a sample out of its block.
    ivec3 block = clamp(ivec3(floor(point / DATA_VOXELS)), ivec3(0), blocks - 1);
    vec4 place = texelFetch(indirection, block, 0);  // the cell's place in its page and 1 + the page, or 0 and the distance
    if (place.w < 0.5) {
      vec3 reach = vec3(place.x - 1.0);
      vec3 corner = vec3(block);
      float leaves = exit_distance(entry, inverse_direction, (corner - reach) * DATA_VOXELS, (corner + 1.0 + reach) * DATA_VOXELS);
      k = max(k + 1, step_at(leaves));
      continue;
    }
    int page = int(place.w + 0.5) - 1;
    vec3 corner = vec3(block) * DATA_VOXELS;
    vec3 offset = place.xyz * CELL_VOXELS + 1.0 - corner;  // from the grid to the page
    int last = min(samples, max(k + 1, step_at(exit_distance(entry, inverse_direction, corner, corner + DATA_VOXELS))));
    bool ask = true;  // whether the coarse voxel may be empty
    while (k < last && transmittance > STOP) {
      vec3 at = entry + (float(k) + 0.5) * direction + offset;
      if (ask) {
        ivec3 coarse = ivec3(at) / 4;
        float empty = skip_at(page, coarse);
        if (empty > 0.5) {
          vec3 nearest = (vec3(coarse) + 1.0 - empty) * 4.0;
          float leaves = exit_distance(entry, inverse_direction, nearest - offset, nearest + (2.0 * empty - 1.0) * 4.0 - offset);
          k = min(max(k + 1, step_at(leaves)), last);  // beyond its own border a cell knows nothing
          continue;
        }
      }
      vec4 texel = rgba_at(page, at);
      rgb += transmittance * texel.rgb;
#ifdef VIEW_DEPENDENCE
      if (texel.a > FEATURES_ABOVE) {  // reading them takes as long as all else: not where there is nothing
        features += transmittance * feature_at(page, at);
      }
#endif
      transmittance *= 1.0 - texel.a;
      if (half_depth < 0.0 && transmittance < 0.5) {
        half_depth = start + float(k) + 0.5;
      }
      ask = texel.a == 0.0;
      ++k;
    }
  }

#ifdef OPACITY_CORRECTION
  float alpha = 1.0 - transmittance;  // equation 9, finite at alpha 0
  float factor = alpha < 2.0 / 3.0 ? 1.5 : 1.0 / alpha;
  rgb *= factor;
  features *= factor;
  transmittance = max(1.0 - factor * alpha, 0.0);
#endif
#ifdef VIEW_DEPENDENCE
  if (transmittance <= NETWORK_TRANSMITTANCE) {
    mat3 to_view = mat3(view.network_axes[0].xyz, view.network_axes[1].xyz, view.network_axes[2].xyz);
    rgb += residual(rgb + transmittance, features, to_view * towards);
  }
#endif
  colour = vec4(rgb, 1.0 - transmittance);
  // A translucent ray has no such depth: what stands behind it stays visible, and what stands in front hides it at its entry.
  float shown = half_depth < 0.0 ? start : half_depth;
  ray_depth = shown * -towards.z * view.voxel.x;  // along the view axis, in world units
}
