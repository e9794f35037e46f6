// The optional modules by their names: files of this folder, which viewer.js does not contain. It loads them with `loadOptional("NAME")`
// when they are wanted; they may import anything from the viewer and from three.js, and share it with viewer.js.
//
// To add one: write NAME.ts here, and name it below and in ../load_optional.ts. core/export/optional_code.py says which pages have it.
export interface OptionalModules {
  annotations: typeof import("./annotations");
  benchmark: typeof import("./benchmark");
  path: typeof import("./path");
  measure: typeof import("./measure");
  vr: typeof import("./vr");
}
