// A scene as an object of three.js, in anybody's scene: meshes may stand before, behind and inside it.
import {
  AlwaysDepth,
  BackSide,
  Box3,
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
  type PerspectiveCamera,
  RawShaderMaterial,
  Sphere,
  Vector2,
  Vector3,
  Vector4,
  type WebGLRenderer,
  type WebGLRenderTarget,
} from "three";
import type { SceneDescription } from "../data/scene";
import type { SnergScene } from "../data/snerg_scene";
import { ViewerError } from "../errors";
import type { Atlas, AtlasTextures } from "./atlas";
import { coveringTriangle } from "./full_screen";
import { type PicturePoint, pickDepths, pickingMaterial, unproject } from "./picking";
import { raySpacePose, raySpaceUnit, similarity, viewUniforms } from "./pose";
import { SceneDepth } from "./scene_depth";
import { fragmentShader, vertexShader } from "./shader";
import { type GrowthOptions, SharedTextures, type TexturesUser } from "./shared_textures";

export interface VolumeOptions {
  /** Whether +Y is up, as in glTF and most three.js scenes. Without it the volume keeps the axes of Blender, where +Z is up. */
  yUp?: boolean;
  /** Whether render targets hold sRGB colours, as the canvas does; three.js itself draws linear ones into them. */
  srgbTargets?: boolean;
}

export type { GrowthOptions };

/**
 * A baked scene in a scene of three.js. It is drawn among the transparent objects, with premultiplied alpha: it stops at what was drawn
 * before, and writes the depth at which half of the light behind it is hidden. It takes any transform of rotation, translation and even
 * scale. Several volumes may stand in one scene.
 *
 * `load` reads its texels; without it the first rendering begins to. Then "change" events say that it looks different (with a coarse scene
 * several times: whenever a layer of cells has arrived), and "error" events carry what failed as `error`.
 */
export class SnergVolume extends Mesh<BufferGeometry, RawShaderMaterial> {
  readonly isSnergVolume = true;
  private readonly content: Matrix4; // the object's axes from the scene's
  private readonly srgbTargets: boolean;
  private loading: Promise<void> | null = null;
  private shaders: [string, string] | null = null; // without and with the depth of what is drawn already; null until it is loaded
  private shared: SharedTextures | null = null; // null until `load`
  private readonly abort = new AbortController();
  private uneven = false;
  private picker: RawShaderMaterial | null = null; // null until it is loaded
  private leave = () => {}; // the textures
  private depthScale = { unit: 1, moved: 0 }; // of the view that was drawn last, see `ViewUniforms`

  constructor(
    readonly source: SnergScene,
    options: VolumeOptions = {},
  ) {
    super(boxOf(source.description), makeMaterial(source.description));
    this.srgbTargets = options.srgbTargets ?? false;
    this.content = options.yUp ? new Matrix4().makeRotationX(-Math.PI / 2) : new Matrix4();
    this.frustumCulled = !source.description.ndc;
    const { center, radius } = sphereOf(source.description);
    const unit = raySpaceUnit(source.description);
    this.geometry.boundingSphere = new Sphere(center.applyMatrix4(this.content), radius);
    this.geometry.boundingBox = source.description.ndc
      ? this.geometry.boundingSphere.getBoundingBox(new Box3())
      : new Box3(new Vector3(), new Vector3(...source.description.shape))
          .applyMatrix4(new Matrix4().makeScale(unit, unit, unit))
          .applyMatrix4(this.content.clone().multiply(raySpacePose(source.description)));
    this.geometry.setDrawRange(0, 0); // until it is loaded
  }

  /** Read the texels and bring them to the graphics card. Rejects with a ViewerError, which is also sent as an "error" event. */
  load(renderer: WebGLRenderer, growth: GrowthOptions = {}): Promise<void> {
    this.loading ??= this.read(renderer, growth).catch((error: unknown) => {
      this.send({ type: "error", error });
      throw error;
    });
    return this.loading;
  }

  /** How many layers of cells have arrived. */
  get layersArrived(): number {
    return this.shared?.layersArrived ?? 0;
  }

  /** How much graphics memory the textures take, in bytes; 0 before `load`. Volumes of one scene share them. */
  get graphicsBytes(): number {
    return this.shared?.bytes ?? 0;
  }

  /** Free the graphics memory, unless another volume shows the same scene; what is still being read only for this one is given up. */
  override dispose(): void {
    this.abort.abort();
    this.leave();
    this.geometry.dispose();
    this.material.dispose();
    this.picker?.dispose();
  }

  /**
   * Where rays through points of a camera's picture have lost half of their light, in the world; null where a ray keeps more. Other objects
   * do not stop them. Wants a volume that is loaded, and all matrices up to date.
   */
  pick(renderer: WebGLRenderer, camera: Camera, points: readonly PicturePoint[]): (Vector3 | null)[] {
    if (!this.picker || !points.length) return points.map(() => null);
    const { material } = this;
    this.material = this.picker;
    const depths = pickDepths(renderer, this, camera, points);
    this.material = material;
    const { unit, moved } = this.depthScale;
    return points.map((point, i) => (depths[i] > 0 ? unproject(camera, point, (depths[i] + moved) * unit) : null));
  }

  /** Nothing: its triangles are not where it is seen. `pick` finds what is seen. */
  override raycast(): void {}

  /** The longest edge of a voxel at a point of the world, in units of the world: how finely the scene is resolved there. */
  voxelAt(point: Vector3): number {
    const scene = this.source.description;
    const scale = this.matrixWorld.getMaxScaleOnAxis();
    if (!scene.ndc) return scene.voxel_size * scale;
    const toFrame = this.matrixWorld.clone().multiply(this.content).multiply(raySpacePose(scene)).invert();
    const [near, depth] = [scene.ndc.near, Math.max(-point.clone().applyMatrix4(toFrame).z, scene.ndc.near)];
    return scene.voxel_size * scale * Math.max(depth ** 2 / (2 * near), depth / Math.min(...scene.ndc.focal));
  }

  private async read(renderer: WebGLRenderer, growth: GrowthOptions): Promise<void> {
    const { signal } = this.abort;
    signal.throwIfAborted();
    const user: TexturesUser = {
      shown: (textures, atlas) => this.show(textures, atlas, freeUnits(renderer, textures) > 0),
      changed: () => this.send({ type: "change" }),
      lost: () => this.hide(),
      failed: (error) => this.send({ type: "error", error }),
    };
    const shared = SharedTextures.join(renderer, this.source, growth, user);
    this.shared = shared;
    this.leave = () => shared.leave(user);
    if (signal.aborted) this.leave();
    const disposed = new Promise<never>((_, reject) => signal.addEventListener("abort", () => reject(signal.reason), { once: true }));
    await Promise.race([this.shared.whole(), disposed]);
  }

  private show(textures: AtlasTextures, atlas: Atlas, sceneDepth: boolean): void {
    const { uniforms } = this.material;
    for (const kind of ["rgba", "feature", "distance"] as const) {
      textures[kind].forEach((texture, i) => {
        uniforms[`${kind}_${i}`] = { value: texture };
      });
    }
    uniforms.indirection = { value: textures.indirection };
    uniforms.texelSize = { value: new Vector3(...atlas.size.map((n) => 1 / n)) };
    const shader = (depth: boolean) => fragmentShader(this.source.description, textures.distance.length, depth);
    this.shaders = [shader(false), shader(sceneDepth)];
    this.picker?.dispose();
    this.picker = pickingMaterial(this.material, fragmentShader(this.source.description, textures.distance.length, false, true));
    this.geometry.setDrawRange(0, Number.POSITIVE_INFINITY);
    this.send({ type: "change" });
  }

  /** The textures are lost: draw nothing, and let three.js make none of them again. */
  private hide(): void {
    this.shaders = null;
    this.geometry.setDrawRange(0, 0);
    for (const uniform of Object.values(this.material.uniforms)) if (uniform.value?.isTexture) uniform.value = null;
  }

  /** Called by three.js before each drawing. */
  override onBeforeRender = (renderer: WebGLRenderer, _scene: unknown, camera: Camera): void => {
    if (!this.loading) this.load(renderer).catch((error: unknown) => console.error(error));
    if (!this.shaders) return;
    const standing = similarity(this.matrixWorld.clone().multiply(this.content));
    if (!standing) return this.refuse();
    this.uneven = false;
    const { uniforms } = this.material;
    if (this.material !== this.picker) {
      const drawn = this.shaders[0] === this.shaders[1] ? null : SceneDepth.of(renderer).copy();
      this.useShader(this.shaders[drawn ? 1 : 0], drawn !== null);
      uniforms.sceneDepth.value = drawn;
    }
    uniforms.gridShape.value.set(...this.source.description.shape);
    const view = viewUniforms(
      this.source.description,
      standing,
      camera,
      renderer.getCurrentViewport(new Vector4()),
      reverseDepth(renderer, camera),
    );
    this.depthScale = view;
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
    const logarithmic = renderer.capabilities.logarithmicDepthBuffer && !view.orthographic;
    uniforms.logDepth.value.set(...(logarithmic ? [view.unit, 1 / Math.log2((camera as PerspectiveCamera).far + 1)] : [0, 0]));
    uniforms.clipFromGrid.value.copy(view.clipFromGrid);
    uniforms.linearOutput.value = this.drawsLinear(renderer);
    this.material.uniformsNeedUpdate = true;
  };

  /** Whether what is drawn to holds linear colours. A headset's picture is one like the canvas. */
  private drawsLinear(renderer: WebGLRenderer): boolean {
    const target = renderer.getRenderTarget() as (WebGLRenderTarget & { isXRRenderTarget?: boolean }) | null;
    const screen = target === null || target.isXRRenderTarget === true;
    return screen ? renderer.outputColorSpace === LinearSRGBColorSpace : !this.srgbTargets;
  }

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

/** Whether the depth buffer is reversed. three.js turns the camera's projection over with the first ordinary mesh that it draws, which may come later. */
function reverseDepth(renderer: WebGLRenderer, camera: Camera): boolean {
  const depth = renderer.state.buffers.depth as typeof renderer.state.buffers.depth & { getReversed?(): boolean };
  if (!depth.getReversed?.()) return false;
  const reversible = camera as PerspectiveCamera & { _reversedDepth?: boolean };
  if (reversible._reversedDepth === false) {
    reversible._reversedDepth = true;
    reversible.updateProjectionMatrix?.();
  }
  return true;
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
    sceneDepth: { value: null },
    depthTerms: { value: new Vector4() },
    logDepth: { value: new Vector2() },
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
