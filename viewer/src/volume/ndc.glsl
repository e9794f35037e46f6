const vec2 NDC_FOCAL = {{NDC_FOCAL}}; // focal lengths over half the frame's size
const mat3 GRID_FROM_NDC = {{GRID_FROM_NDC}}; // voxels an NDC unit
const vec3 NDC_CORNER = {{NDC_CORNER}}; // of the grid, in NDC

// Turn a ray of a forward-facing scene into a ray of the grid, in voxels, and `near` and `far` into where it begins and ends. The grid lies in
// normalised device coordinates (core/geometry/ndc.py): x' = -fx x / z, y' = -fy y / z, z' = 1 + 2 / z in the frame's axes, in
// units of its near plane's distance. The ray begins on the near plane or at `near`, whichever is farther. A ray parallel to the
// near plane or away from it becomes one that begins behind the grid (z' = 2) and leaves it.
void toGrid(inout vec3 origin, inout vec3 direction, inout float near, inout float far) {
  vec3 point = vec3(0.0, 0.0, 2.0);
  vec3 end = point;
  vec3 ndcDirection = vec3(0.0, 0.0, 1.0);
  if (direction.z < -1e-6) {
    vec3 start = origin + max(near, (-1.0 - origin.z) / direction.z) * direction;
    start.z = min(start.z, -1.0);
    point = vec3(-NDC_FOCAL * start.xy / start.z, 1.0 + 2.0 / start.z);
    vec3 last = origin + far * direction;
    end = last.z < start.z ? vec3(-NDC_FOCAL * last.xy / last.z, 1.0 + 2.0 / last.z) : point;
    ndcDirection = vec3(direction.z * point.xy + NDC_FOCAL * direction.xy, -direction.z * (1.0 - point.z));
  }
  origin = GRID_FROM_NDC * (point - NDC_CORNER);
  direction = normalize(GRID_FROM_NDC * ndcDirection);
  near = 0.0;
  if (far < 1e8) far = length(GRID_FROM_NDC * (end - point)); // else there is no far plane, and the ray ends where it leaves the grid
}

// A point of the grid, in voxels, in ray space.
vec3 fromGrid(vec3 point) {
  vec3 ndc = inverse(GRID_FROM_NDC) * point + NDC_CORNER;
  float z = 2.0 / (ndc.z - 1.0);
  return vec3(-ndc.xy * z / NDC_FOCAL, z);
}
