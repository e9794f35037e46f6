// A baked scene and a glTF model in one scene of three.js: each hides what of the other lies behind it.
import { Color, DirectionalLight, HemisphereLight, Scene, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { readCameras, ServerFiles, SnergScene, SnergVolume, threeCamera } from "../../src/index";

const canvas = document.getElementById("canvas") as HTMLCanvasElement;
const renderer = new WebGLRenderer({ canvas });
const world = new Scene();
world.background = new Color("white");
world.add(new HemisphereLight(0xffffff, 0x888888, 2), new DirectionalLight(0xffffff, 2));

async function start(): Promise<void> {
  const folder = new ServerFiles("bundle"); // as `snerg bundle` writes it
  const [scene, { cameras }, model] = await Promise.all([
    SnergScene.load(folder, { folder: "scene/" }),
    readCameras(folder, "cameras.json"),
    new GLTFLoader().loadAsync("model.gltf"),
  ]);
  const [first] = cameras;
  const volume = new SnergVolume(scene, { yUp: true });
  world.add(volume, model.scene);
  const camera = threeCamera(first, { yUp: true });
  renderer.setSize(first.width, first.height);
  await volume.load(renderer);
  const draw = () => renderer.render(world, camera);
  draw();
  const controls = new OrbitControls(camera, canvas);
  controls.addEventListener("change", draw);
}

Object.assign(window, { ready: start() });
