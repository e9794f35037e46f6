// A scene as an object of three.js, in anybody's scene: meshes may stand before, behind and inside it.
import {
  AlwaysDepth,
  BackSide,
  BoxGeometry,
  type BufferGeometry,
  type Camera,
  CustomBlending,
  GLSL3,
  LinearSRGBColorSpace,
  Matrix3,
  Matrix4,
  Mesh,
  OneFactor,
  OneMinusSrcAlphaFactor,
  RawShaderMaterial,
  Sphere,
  Vector2,
  Vector3,
  Vector4,
  type WebGLRenderer,
} from "three";
import type { SceneDescription } from "../data/scene";
import type { SnergScene } from "../data/snerg_scene";
import { ViewerError } from "../errors";
import { Atlas, type AtlasTextures } from "./atlas";
import { coveringTriangle } from "./full_screen";
import { raySpacePose, raySpaceUnit, similarity, viewUniforms } from "./pose";
import { SceneDepth } from "./scene_depth";
import { fragmentShader, vertexShader } from "./shader";

export interface VolumeOptions {
  /** Whether +Y is up, as in glTF and most three.js scenes. Without it the volume keeps the axes of Blender, where +Z is up. */
  yUp?: boolean;
  /** Whether render targets hold sRGB colours, as the canvas does; three.js itself draws linear ones into them. */
  srgbTargets?: boolean;
}

/**
 * A baked scene in a scene of three.js. It is drawn among the transparent objects, with premultiplied alpha: it stops at what was drawn
 * before, and writes the depth at which half of the light behind it is hidden. It takes any transform of rotation, translation and even
 * scale. Several volumes may stand in one scene.
 *
 * `load` reads its texels; without it the first rendering begins to. Then "change" events say that it looks different, and "error" events
 * carry what failed as `error`.
 */
export class SnergVolume extends Mesh<BufferGeometry, RawShaderMaterial> {
  readonly isSnergVolume = true;
  private readonly content: Matrix4; // the object's axes from the scene's
  private readonly srgbTargets: boolean;
  private loading: Promise<void> | null = null;
  private shaders: [string, string] | null = null; // without and with the depth of what is drawn already; null until it is loaded
  private atlas: Atlas | null = null;
  private readonly abort = new AbortController();
  private uneven = false;

  constructor(
    readonly source: SnergScene,
    options: VolumeOptions = {},
  ) {
    super(boxOf(source.description), makeMaterial(source.description));
    this.srgbTargets = options.srgbTargets ?? false;
    this.content = options.yUp ? new Matrix4().makeRotationX(-Math.PI / 2) : new Matrix4();
    this.frustumCulled = !source.description.ndc;
    const { center, radius } = sphereOf(source.description);
    this.geometry.boundingSphere = new Sphere(center.applyMatrix4(this.content), radius);
    this.geometry.setDrawRange(0, 0); // until it is loaded
  }

  /** Read the texels and bring them to the graphics card. Rejects with a ViewerError, which is also sent as an "error" event. */
  load(renderer: WebGLRenderer): Promise<void> {
    this.loading ??= this.read(renderer).catch((error: unknown) => {
      this.send({ type: "error", error });
      throw error;
    });
    return this.loading;
  }

  /** How much graphics memory the texels take, in bytes; 0 before `load`. */
  get graphicsBytes(): number {
    return this.atlas?.bytes ?? 0;
  }

  /** Free the graphics memory; what is still being read is given up. */
  override dispose(): void {
    this.abort.abort();
    this.atlas?.dispose();
    this.geometry.dispose();
    this.material.dispose();
  }

  private async read(renderer: WebGLRenderer): Promise<void> {
    const scene = this.source.description;
    this.atlas = new Atlas(renderer, scene);
    const atlas = this.atlas;
    await this.source.readSlices((slice, texels) => atlas.take(slice, texels), this.abort.signal);
    const textures = atlas.textures(this.source.cells);
    this.show(textures, freeUnits(renderer, textures) > 0);
  }

  private show(textures: AtlasTextures, sceneDepth: boolean): void {
    const { uniforms } = this.material;
    for (const kind of ["rgba", "feature", "distance"] as const) {
      textures[kind].forEach((texture, i) => {
        uniforms[`${kind}_${i}`] = { value: texture };
      });
    }
    uniforms.indirection = { value: textures.indirection };
    uniforms.texelSize = { value: new Vector3(...(this.atlas as Atlas).size.map((n) => 1 / n)) };
    const shader = (depth: boolean) => fragmentShader(this.source.description, textures.distance.length, depth);
    this.shaders = [shader(false), shader(sceneDepth)];
    this.geometry.setDrawRange(0, Number.POSITIVE_INFINITY);
    this.send({ type: "change" });
  }

  /** Called by three.js before each drawing. */
  override onBeforeRender = (renderer: WebGLRenderer, _scene: unknown, camera: Camera): void => {
    if (!this.loading) this.load(renderer).catch((error: unknown) => console.error(error));
    if (!this.shaders) return;
    const standing = similarity(this.matrixWorld.clone().multiply(this.content));
    if (!standing) return this.refuse();
    const { uniforms } = this.material;
    const drawn = this.shaders[0] === this.shaders[1] ? null : SceneDepth.of(renderer).copy();
    this.useShader(this.shaders[drawn ? 1 : 0], drawn !== null);
    uniforms.gridShape.value.set(...this.source.description.shape);
    uniforms.featuresAbove.value = this.atlas?.strayFeatures ? -1 : 0;
    uniforms.sceneDepth.value = drawn;
    const reversed = (renderer as WebGLRenderer & { reversedDepthBuffer?: boolean }).reversedDepthBuffer === true;
    const view = viewUniforms(this.source.description, standing, camera, renderer.getCurrentViewport(new Vector4()), reversed);
    uniforms.focal.value.set(...view.focal);
    uniforms.principalPoint.value.set(...view.principalPoint);
    uniforms.viewport.value.set(...view.viewport);
    uniforms.orthographic.value = view.orthographic;
    uniforms.cameraPosition.value.copy(view.cameraPosition);
    uniforms.raySpaceFromCamera.value.setFromMatrix4(view.raySpaceFromCamera);
    uniforms.networkFromCamera.value.setFromMatrix4(view.networkFromCamera);
    uniforms.nearDistance.value = view.nearDistance;
    uniforms.clipPlanes.value.set(...view.clipPlanes);
    uniforms.depthTerms.value.copy(view.depthTerms);
    uniforms.clipFromGrid.value.copy(view.clipFromGrid);
    uniforms.linearOutput.value = renderer.getRenderTarget() ? !this.srgbTargets : renderer.outputColorSpace === LinearSRGBColorSpace;
    this.material.uniformsNeedUpdate = true;
  };

  /** Take the shader with or without what is drawn already. */
  private useShader(shader: string, sceneDepth: boolean): void {
    const { material } = this;
    if (material.fragmentShader === shader) return;
    material.fragmentShader = shader;
    material.depthTest = material.depthWrite = sceneDepth; // WebGL writes depth only where it tests it
    material.needsUpdate = true;
  }

  private refuse(): void {
    this.material.uniforms.gridShape.value.set(0, 0, 0); // every ray misses it
    if (this.uneven) return;
    this.uneven = true;
    const text = "A SNeRG volume is scaled unevenly, sheared or mirrored, which it cannot be: give it the same scale along x, y and z.";
    console.error(text);
    this.send({ type: "error", error: new ViewerError(text) });
  }

  private send(event: { type: string; error?: unknown }): void {
    this.dispatchEvent(event as never);
  }
}

/** How many texture units are left beside the scene's own. */
function freeUnits(renderer: WebGLRenderer, textures: AtlasTextures): number {
  const gl = renderer.getContext();
  const used = textures.rgba.length + textures.feature.length + textures.distance.length + 1;
  return gl.getParameter(gl.MAX_TEXTURE_IMAGE_UNITS) - used;
}

/** The box of the grid, in voxels; of a forward-facing scene a triangle that covers the image. */
function boxOf(scene: SceneDescription): BufferGeometry {
  if (scene.ndc) return coveringTriangle();
  const [x, y, z] = scene.shape;
  return new BoxGeometry(x, y, z).translate(x / 2, y / 2, z / 2);
}

/** The sphere round the scene, in its own axes; of a forward-facing scene, round the depth at the middle of its NDC. */
export function sphereOf(scene: SceneDescription): { center: Vector3; radius: number } {
  const unit = raySpaceUnit(scene);
  const toCentre = scene.ndc ? new Vector3(0, 0, -2 * unit) : new Vector3(...scene.shape).multiplyScalar(unit / 2);
  return { radius: toCentre.length(), center: toCentre.applyMatrix4(raySpacePose(scene)) };
}

function makeMaterial(scene: SceneDescription): RawShaderMaterial {
  const uniforms = {
    focal: { value: new Vector2() },
    principalPoint: { value: new Vector2() },
    viewport: { value: new Vector3() },
    orthographic: { value: false },
    cameraPosition: { value: new Vector3() },
    raySpaceFromCamera: { value: new Matrix3() },
    networkFromCamera: { value: new Matrix3() },
    nearDistance: { value: 0 },
    clipPlanes: { value: new Vector2() },
    gridShape: { value: new Vector3(...scene.shape) },
    gridBlocks: { value: new Vector3(...scene.blocks) },
    linearOutput: { value: false },
    featuresAbove: { value: 0 },
    sceneDepth: { value: null },
    depthTerms: { value: new Vector4() },
    clipFromGrid: { value: new Matrix4() },
  };
  return new RawShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: vertexShader(scene),
    fragmentShader: "precision highp float; out vec4 colour; void main() { colour = vec4(0.0); }",
    uniforms,
    transparent: true,
    premultipliedAlpha: true,
    blending: CustomBlending,
    blendSrc: OneFactor,
    blendDst: OneMinusSrcAlphaFactor,
    side: scene.ndc ? undefined : BackSide, // the camera may be inside the box
    depthTest: false,
    depthWrite: false,
    depthFunc: AlwaysDepth,
  });
}
