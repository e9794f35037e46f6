"""The settings of a scene, one property group. Blender reads these annotations as values, hence no postponed evaluation here."""

# mypy: disable-error-code="valid-type"

import math
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty, IntProperty, PointerProperty, StringProperty

from ..core.data.dataset import DatasetOptions
from ..core.data.rig import RigSettings
from ..core.export.codecs import LOSSLESS, SUFFIXES, CodecSettings
from ..core.export.page_settings import BACKGROUNDS, THUMBNAILS

# Blender 5 shows a path that starts with // in red unless the property has this option.
RELATIVE_PATHS = {"PATH_SUPPORTS_BLEND_RELATIVE"}

LOSSY = tuple(name for name in SUFFIXES if name not in LOSSLESS)


def _is_empty(_settings: Any, thing: bpy.types.Object) -> bool:
    return bool(thing.type == "EMPTY")


class SNERG_PG_scene(bpy.types.PropertyGroup):
    """SNeRG's settings for this scene"""

    folder: StringProperty(
        name="Project Folder",
        description="Where the dataset, the fields, the baked scenes and the exports are stored. "
        "Empty: a folder for this file and scene, beside the .blend",
        subtype="DIR_PATH",
        options=RELATIVE_PATHS,
        default="",
    )
    follows: PointerProperty(
        name="Composited With",
        description="The scene whose camera and picture size this one renders with, as the compositor asks it to",
        type=bpy.types.Scene,
        options={"HIDDEN"},
    )
    project_id: StringProperty(name="Project", description="Identifies this scene's project", options={"HIDDEN"}, default="")
    dataset: StringProperty(
        name="Dataset",
        description="The dataset to train on: a folder with images and a transforms.json, poses_bounds.npy or COLMAP model. "
        "Empty: the dataset rendered from this scene",
        subtype="DIR_PATH",
        options=RELATIVE_PATHS,
        default="",
    )

    cameras: EnumProperty(
        name="Cameras",
        description="The cameras to render the dataset from",
        items=[
            ("ALL", "All", "Every camera of the scene"),
            ("SELECTED", "Selected", "The selected cameras"),
            ("ACTIVE", "Active", "The active camera; over frames, also the cameras that markers choose"),
            ("RIG", "Rig", "Cameras spread evenly around the box, with the scene's resolution"),
        ],
        default="ALL",
    )
    test_every: IntProperty(
        name="Hold Out Every",
        description="Use every n-th view to measure the quality instead of training on it, unless the dataset says which. 0: hold out none",
        default=DatasetOptions.holdout,
        min=0,
        soft_max=20,
    )
    over_frames: BoolProperty(
        name="Over Frames",
        description="Render each camera at frames of the scene's range, for cameras that move. What else moves is blurred in the field",
        default=False,
    )
    frame_step: IntProperty(name="Step", description="Render every n-th frame", default=1, min=1, soft_max=50)
    test_cameras: PointerProperty(
        name="Test Cameras",
        description="A collection: the views of its cameras measure the quality, and all others are trained on. "
        "Empty: Hold Out Every decides",
        type=bpy.types.Collection,
    )
    view_layer: StringProperty(
        name="View Layer", description="The view layer to render, and to fit the box to. Empty: the scene's first", default=""
    )
    look: EnumProperty(
        name="Look",
        description="The colours of the dataset, and of all that is trained on it",
        items=[
            ("STANDARD", "Standard", "sRGB without a view transform, look or exposure: for colours that other tools and web pages share"),
            ("SCENE", "Scene's", "The scene's own view transform, look, exposure and gamma: as F12 shows it"),
        ],
        default="STANDARD",
    )
    downscale: IntProperty(
        name="Downscale",
        description="Train on images this many times smaller in width and height: faster, but less sharp",
        default=DatasetOptions.downscale,
        min=1,
        soft_max=8,
        max=64,
    )
    render_depth: BoolProperty(
        name="Depth",
        description="Write the depth of each view, as OpenEXR beside the pictures: the exact distance along the camera's axis",
        default=True,
    )
    render_normals: BoolProperty(name="Normals", description="Write the surface normals of each view, in the scene's axes", default=False)
    render_light: BoolProperty(
        name="Diffuse, Glossy",
        description="Write for each view which light comes from diffuse and which from glossy surfaces (linear, OpenEXR)",
        default=False,
    )
    rig_count: IntProperty(name="Count", description="Number of cameras of the rig", default=RigSettings.count, min=1, soft_max=500)
    rig_shape: EnumProperty(
        name="Shape",
        description="Where the rig's cameras are placed",
        items=[
            ("HEMISPHERE", "Hemisphere", "Above the centre of the box: for objects that stand on the ground"),
            ("SPHERE", "Sphere", "All around the box"),
        ],
        default="HEMISPHERE",
    )
    rig_angle: FloatProperty(
        name="Field of View",
        description="Field of view of the rig's cameras along the shorter side of the image",
        subtype="ANGLE",
        default=RigSettings.angle,
        min=math.radians(1),
        max=math.radians(150),
    )
    rig_distance: FloatProperty(
        name="Distance",
        description="Distance of the rig's cameras from the centre of the box. 0: the whole box just fits into the image",
        subtype="DISTANCE",
        default=RigSettings.distance,
        min=0.0,
    )

    preset: EnumProperty(
        name="Method",
        description="The kind of field to train",
        items=[
            ("fast", "Fast", "A hash grid with a small network: good results in minutes on a CPU"),
            ("mlp", "MLP", "A network like the paper's, with the sampling of Fast: for comparison"),
            ("paper-small", "Paper, Small", "The paper's method with smaller networks: hours on a GPU"),
            ("paper", "Paper", "The paper's method with its full networks: many hours on several GPUs"),
        ],
        default="fast",
    )
    view_dependence: EnumProperty(
        name="Highlights",
        description="How colours may change with the viewing direction (view dependence)",
        items=[
            ("auto", "Auto", "Deferred or Diffuse, as a test on the images decides"),
            ("deferred", "Deferred", "Highlights from a small network, evaluated once per pixel, as in the baked scene"),
            ("diffuse", "Diffuse", "No highlights: the smallest and fastest scenes"),
            ("sample", "Per Sample", "NeRF's network at every sample. Cannot be baked; for comparison"),
            ("tiny", "Per Sample, Small", "The small network at every sample. Cannot be baked; for comparison"),
        ],
        default="auto",
    )
    train_background: EnumProperty(
        name="Background",
        description="What is behind the transparent parts of the images in training",
        items=[
            ("white", "White", ""),
            ("black", "Black", ""),
            ("random", "Random", "A new colour each time, so that transparent parts become empty space"),
            ("colour", "Colour", "A colour of your choice"),
        ],
        default="white",
    )
    train_colour: FloatVectorProperty(
        name="Colour",
        description="The colour behind the transparent parts of the images in training",
        subtype="COLOR_GAMMA",
        size=3,
        default=(0.5, 0.5, 0.5),
        min=0.0,
        max=1.0,
    )
    minutes: FloatProperty(
        name="Minutes",
        description="How long to train. An unfinished training continues with the time that is left",
        default=5.0,
        min=0.05,
        soft_max=60.0,
        precision=1,
        step=50,
    )
    steps: IntProperty(
        name="Steps",
        description="Train for a number of steps instead of minutes, so that the result can be repeated exactly. 0: use Minutes",
        default=0,
        min=0,
        soft_max=100000,
    )
    show_training: BoolProperty(
        name="Show While Training",
        description="Show the field so far in the viewport, baked coarsely now and then. This takes up to 4 % of the training's time",
        default=True,
    )
    seed: IntProperty(name="Seed", description="Random seed of the training: the same seed and steps give the same field", default=0, min=0)

    box: PointerProperty(
        name="Box",
        description="The empty whose cube is baked. Only what is inside it becomes part of the baked scene",
        type=bpy.types.Object,
        poll=_is_empty,
    )

    resolution: IntProperty(
        name="Voxels",
        description="Number of voxels along the longest side of the box. Twice the number shows details half the size "
        "and takes about six times the memory",
        default=256,
        min=8,
        max=2048,
        soft_min=64,
        soft_max=800,
    )
    study_minutes: FloatProperty(
        name="Minutes",
        description="How long the study may run. Start it again to measure what is left",
        default=10.0,
        min=0.5,
        soft_max=60.0,
    )
    target_db: FloatProperty(
        name="Target dB",
        description="Bake the smallest and fastest configuration that reaches this PSNR on held-out views. 0: bake none",
        default=0.0,
        min=0.0,
        soft_max=45.0,
    )
    voxel_size: FloatProperty(
        name="Voxel Size",
        description="Size of a voxel, instead of the number of voxels. 0: use Voxels",
        subtype="DISTANCE",
        default=0.0,
        min=0.0,
        precision=4,
        step=1,
    )
    show_voxels: BoolProperty(
        name="Show Voxels",
        description="Draw the voxels of the bake on three faces of the box, several as one where they would be too many to see",
        default=False,
    )
    samples: IntProperty(
        name="Samples",
        description="Samples of the field per voxel. More give smoother edges and take longer. 0: chosen automatically",
        default=0,
        min=0,
        soft_max=16,
        max=64,
    )
    refine: BoolProperty(
        name="Refine Highlights",
        description="After baking, fine-tune the highlights on the training images, because voxels change them slightly",
        default=True,
    )
    fit: BoolProperty(
        name="Fit Voxels",
        description="After baking, fit voxels and highlights to the training images. Takes longer, and gains most with few voxels",
        default=False,
    )
    prune: FloatProperty(
        name="Drop Below",
        description="Drop voxels that make up less than this share of every training pixel, for smaller files. 0: drop none",
        default=0.0,
        min=0.0,
        soft_max=0.05,
        max=0.99,
        precision=3,
        step=0.1,
    )

    transparent: BoolProperty(name="Transparent", description="Render the preview with a transparent background", default=False)
    background: FloatVectorProperty(
        name="Background",
        description="Colour behind the baked scene in the preview",
        subtype="COLOR_GAMMA",
        size=3,
        default=(1.0, 1.0, 1.0),
        min=0.0,
        max=1.0,
    )

    web_cameras: EnumProperty(
        name="Page Cameras",
        description="Cameras to choose from on the web page",
        items=[
            ("ACTIVE", "Active", "The scene's active camera"),
            ("SELECTED", "Selected", "The selected cameras"),
            ("ALL", "All", "Every camera of the scene"),
        ],
        default="ALL",
    )
    web_thumbnails: IntProperty(
        name="Thumbnails",
        description="Cameras with a small picture in the page's list: 1 to 4 KB and about 0.3 seconds each, at most half a minute in all",
        default=THUMBNAILS,
        min=0,
        max=1000,
        soft_max=100,
    )
    web_path: BoolProperty(
        name="Camera Move",
        description="Let the page play the active camera over the frame range, with a cut at each marker that has a camera",
        default=True,
    )
    web_play: BoolProperty(
        name="Play at Once",
        description="Play the camera move as soon as the scene is there, except for people who asked their device for less motion",
        default=False,
    )
    codec: EnumProperty(
        name="Image Format",
        description="Format of the web page's images. Opacity is always stored lossless",
        items=[
            ("scene", "As Baked", "The files of the baked scene, unchanged"),
            ("png", "PNG", "Lossless"),
            ("webp", "WebP", "Lossless, and smaller than PNG"),
            ("jxl", "JPEG XL", "Lossless, and the smallest; browsers that do not know it load WebP. Needs the package pillow-jxl-plugin"),
            ("jpeg", "JPEG", "Small, lossy"),
            ("avif", "AVIF", "Smallest at the same quality, but slow to write"),
        ],
        default="scene",
    )
    quality: IntProperty(
        name="Quality",
        description="Quality of JPEG and AVIF: higher values give larger files",
        default=CodecSettings.quality,
        min=1,
        max=100,
    )
    half_features: BoolProperty(
        name="Half Features",
        description="Store the features, which the view dependence is computed from, at half the resolution: about half of all bytes",
        default=False,
    )
    page_title: StringProperty(name="Title", description="Of the page, also where a link to it is shared. Empty: SNeRG")
    page_description: StringProperty(name="Description", description="A sentence that search engines and shared links show")
    page_address: StringProperty(
        name="Address", description="Where the page will be published, as https://example.org/page: shared links then show its picture"
    )
    page_background: EnumProperty(
        name="Background",
        description="Behind the scene at first; people who look at the page can change it",
        items=[
            *((name, name.capitalize(), "") for name in BACKGROUNDS),
            ("colour", "Colour", "Any colour"),
            ("transparent", "Transparent", "What is behind the frame in which the page stands"),
            ("image", "Picture", "A picture, which is copied into the page, made smaller where it is large"),
        ],
        default="white",
    )
    page_colour: FloatVectorProperty(
        name="Colour", description="Behind the scene", subtype="COLOR_GAMMA", size=3, default=(0.05, 0.05, 0.05), min=0.0, max=1.0
    )
    page_image: StringProperty(name="Picture", description="Behind the scene", subtype="FILE_PATH", options=RELATIVE_PATHS)
    page_mode: EnumProperty(
        name="Movement",
        description="How people move at first; they can change it",
        items=[
            ("orbit", "Orbit", "Around the scene"),
            ("fly", "Fly", "Freely through the scene, for scenes seen from inside"),
            ("walk", "Walk", "Upright and level through the scene, for scenes seen from inside"),
        ],
        default="orbit",
    )
    page_quality: EnumProperty(
        name="Quality",
        description="How fine the page's picture is at first, and how much graphics memory it takes; people can change it",
        items=[
            ("auto", "Automatic", "What suits the device of each person who looks at the page"),
            ("phone", "Phone", "Few pixels, little graphics memory: a large scene is shown at a quarter of its resolution"),
            ("balanced", "Balanced", "For tablets and laptops"),
            ("full", "Full", "All pixels and the whole scene, with the smoothest edges"),
        ],
        default="auto",
    )
    limits_orbit: BoolProperty(
        name="Limit the Orbit", description="Bound how near and far, how low and high people may orbit the scene", default=False
    )
    orbit_distance: FloatVectorProperty(
        name="Distance",
        description="Nearest and farthest distance from the point that is looked at",
        size=2,
        unit="LENGTH",
        default=(1.0, 10.0),
        min=1e-4,
    )
    orbit_elevation: FloatVectorProperty(
        name="Elevation",
        description="Lowest and highest angle above the horizon",
        size=2,
        unit="ROTATION",
        default=(0.0, math.pi / 2),
        min=-math.pi / 2,
        max=math.pi / 2,
    )
    shows_annotations: BoolProperty(name="Annotations", description="Show the annotations below as labels in the page", default=True)
    measures: BoolProperty(
        name="Measuring", description="Let people measure lengths in the page, in the units of this scene", default=False
    )
    enters_vr: BoolProperty(name="VR", description="Let people with a headset enter the scene, at its size in metres", default=False)
    single_file: BoolProperty(
        name="Single File",
        description="Write one .html file that opens without a web server, instead of a folder",
        default=False,
    )


CLASSES = (SNERG_PG_scene,)
