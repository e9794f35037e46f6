// A forward-facing scene's grid lies in normalised device coordinates (core/geometry/ndc.py says the same): x' = -fx x / z,
// y' = -fy y / z, z' = 1 + 2 / z in the axes of its frame, in units of the frame's near plane.
// Rays given there become rays of the grid, in voxels, that begin on the near plane or at `near`; one that runs parallel to that
// plane or away from it begins past infinity, on its way out.
void toGrid(inout vec3 origin, inout vec3 direction, inout float near) {
  vec3 point = vec3(0.0, 0.0, 2.0);
  vec3 along = vec3(0.0, 0.0, 1.0);
  if (direction.z < -1e-6) {
    vec3 start = origin + max(near, (-1.0 - origin.z) / direction.z) * direction;
    start.z = min(start.z, -1.0);
    point = vec3(-NDC_FOCAL * start.xy / start.z, 1.0 + 2.0 / start.z);
    along = vec3(direction.z * point.xy + NDC_FOCAL * direction.xy, -direction.z * (1.0 - point.z));
  }
  origin = GRID_FROM_NDC * (point - NDC_CORNER);
  direction = normalize(GRID_FROM_NDC * along);
  near = 0.0;
}
