// What the build puts into the code: files as text.
declare module "*.glsl" {
  const text: string;
  export default text;
}
declare module "*.css" {
  const text: string;
  export default text;
}
declare module "*.html" {
  const text: string;
  export default text;
}
// What optional scripts import from viewer.js, by module and name (build.mjs).
declare module "snerg-shared" {
  export const SHARED: Readonly<Record<string, unknown>>;
}
