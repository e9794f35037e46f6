"""What the artist sets, one group on the scene. Blender reads these annotations as values, hence no postponed evaluation here."""

# mypy: disable-error-code="valid-type"

import math
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty, IntProperty, PointerProperty, StringProperty

# Blender 5 marks a path that starts with // red unless it is said to be one that may.
RELATIVE_PATHS = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (5, 0) else set()

LOSSY = ("jpeg", "avif")  # of the codecs below, those that have a quality


def _is_empty(_settings: Any, thing: bpy.types.Object) -> bool:
    return bool(thing.type == "EMPTY")


class SNERG_PG_scene(bpy.types.PropertyGroup):
    """SNeRG's settings for this scene"""

    folder: StringProperty(
        name="Project Folder",
        description="Where the dataset, the fields, the baked scenes and the exports go. "
        "Empty: a folder of this file and scene, beside the .blend",
        subtype="DIR_PATH",
        options=RELATIVE_PATHS,
        default="",
    )
    project_id: StringProperty(
        name="Project", description="Tells this scene's project from those of copies", options={"HIDDEN"}, default=""
    )
    dataset: StringProperty(
        name="Dataset",
        description="What to train on: a folder with a transforms.json, poses_bounds.npy or COLMAP model and its images. "
        "Empty: what was rendered into the project folder",
        subtype="DIR_PATH",
        options=RELATIVE_PATHS,
        default="",
    )

    cameras: EnumProperty(
        name="Cameras",
        description="Where the views are rendered from",
        items=[
            ("ALL", "All", "Every camera of the scene"),
            ("SELECTED", "Selected", "The selected cameras"),
            ("RIG", "Rig", "Cameras spread evenly round the box, with the scene's resolution"),
        ],
        default="ALL",
    )
    test_every: IntProperty(
        name="Hold Out Every",
        description="Every n-th view is kept out of training, to measure the quality on, where the dataset does not say which. "
        "0 keeps none out",
        default=8,
        min=0,
        soft_max=20,
    )
    downscale: IntProperty(
        name="Downscale",
        description="Train on pictures this many times smaller along each side: faster, and less sharp",
        default=1,
        min=1,
        soft_max=8,
        max=64,
    )
    rig_count: IntProperty(name="Cameras", description="How many cameras the rig has", default=100, min=1, soft_max=500)
    rig_shape: EnumProperty(
        name="Shape",
        description="Where the rig's cameras stand",
        items=[
            ("HEMISPHERE", "Hemisphere", "Above the middle of the box: for things that stand on the ground"),
            ("SPHERE", "Sphere", "All round the box"),
        ],
        default="HEMISPHERE",
    )
    rig_angle: FloatProperty(
        name="Field of View",
        description="Field of view of the rig's cameras across the shorter side of the picture",
        subtype="ANGLE",
        default=math.radians(40),
        min=math.radians(1),
        max=math.radians(150),
    )
    rig_distance: FloatProperty(
        name="Distance",
        description="From the middle of the box to the rig's cameras. 0: so that the whole box just fits into the picture",
        subtype="DISTANCE",
        default=0.0,
        min=0.0,
    )

    preset: EnumProperty(
        name="Preset",
        description="The kind of field to train",
        items=[
            ("fast", "Fast", "A hash grid with a small network: good in minutes on a CPU"),
            ("mlp", "MLP", "A network as in the paper, on the samples of Fast: to compare with"),
            ("paper-small", "Paper, Small", "The smaller networks of the paper, coarse and fine: hours on a GPU"),
            ("paper", "Paper", "The large networks of the paper, coarse and fine: many hours on several GPUs"),
        ],
        default="fast",
    )
    view_dependence: EnumProperty(
        name="View Dependence",
        description="What may look different from different sides",
        items=[
            ("auto", "Auto", "Deferred or diffuse, whichever the pictures call for"),
            ("deferred", "Deferred", "Highlights from one small network a pixel, as a baked scene has them"),
            ("diffuse", "Diffuse", "None: the smallest and fastest scenes"),
            ("sample", "Per Sample", "NeRF's own, at every sample. It cannot be baked: to compare with"),
            ("tiny", "Tiny, per Sample", "The small network at every sample. It cannot be baked: to compare with"),
        ],
        default="auto",
    )
    train_background: EnumProperty(
        name="Background",
        description="What stands behind the transparent parts of the pictures in training",
        items=[
            ("white", "White", ""),
            ("black", "Black", ""),
            ("random", "Random", "Another colour each time: what is transparent becomes empty"),
            ("colour", "Colour", "One of your own"),
        ],
        default="white",
    )
    train_colour: FloatVectorProperty(
        name="Colour",
        description="What stands behind the transparent parts of the pictures in training",
        subtype="COLOR_GAMMA",
        size=3,
        default=(0.5, 0.5, 0.5),
        min=0.0,
        max=1.0,
    )
    minutes: FloatProperty(
        name="Minutes",
        description="How long to train. Training again continues from where it stopped",
        default=5.0,
        min=0.05,
        soft_max=60.0,
        precision=1,
        step=50,
    )
    steps: IntProperty(
        name="Steps",
        description="Train this many steps instead of a time, so that the result can be repeated exactly. 0: go by the minutes",
        default=0,
        min=0,
        soft_max=100000,
    )
    seed: IntProperty(name="Seed", description="Of everything random in training: the same seed gives the same field", default=0, min=0)

    box: PointerProperty(
        name="Box",
        description="The empty whose cube is baked. Only what is inside becomes part of the baked scene",
        type=bpy.types.Object,
        poll=_is_empty,
    )

    resolution: IntProperty(
        name="Voxels",
        description="Voxels along the longest side of the box. Twice as many show half the detail size and take about six times the memory",
        default=256,
        min=8,
        max=2048,
        soft_min=64,
        soft_max=800,
    )
    study_minutes: FloatProperty(
        name="Minutes",
        description="How long a study may measure. What does not fit is measured when it is started again",
        default=10.0,
        min=0.5,
        soft_max=60.0,
    )
    target_db: FloatProperty(
        name="Target dB",
        description="Bake the cheapest configuration measured that is at least so good on held-out views. 0: bake none",
        default=0.0,
        min=0.0,
        soft_max=45.0,
    )
    voxel_size: FloatProperty(
        name="Voxel Size",
        description="How large a voxel is, in place of their number. 0: go by the number",
        subtype="DISTANCE",
        default=0.0,
        min=0.0,
        precision=4,
        step=1,
    )
    samples: IntProperty(
        name="Samples",
        description="Samples of the field in each voxel. More give smoother edges and take longer. "
        "0: as many as turn out to be worth their time",
        default=0,
        min=0,
        soft_max=16,
        max=64,
    )
    refine: BoolProperty(
        name="Refine Highlights",
        description="Afterwards train the view-dependence network on the baked scene, so that highlights match the photographs again",
        default=True,
    )

    transparent: BoolProperty(name="Transparent", description="Leave the preview's background transparent", default=False)
    background: FloatVectorProperty(
        name="Background",
        description="What shows behind the baked scene in the preview",
        subtype="COLOR_GAMMA",
        size=3,
        default=(1.0, 1.0, 1.0),
        min=0.0,
        max=1.0,
    )

    web_cameras: EnumProperty(
        name="Cameras",
        description="The cameras that the web page lists to jump to",
        items=[
            ("ACTIVE", "Active", "The scene's active camera"),
            ("SELECTED", "Selected", "The selected cameras"),
            ("ALL", "All", "Every camera of the scene"),
        ],
        default="ALL",
    )
    codec: EnumProperty(
        name="Pictures",
        description="How the web page's pictures are stored. What is transparent is stored without loss in any case",
        items=[
            ("scene", "As Baked", "The files of the baked scene as they are"),
            ("png", "PNG", "Without loss"),
            ("webp", "WebP", "Without loss, and smaller than PNG"),
            ("jpeg", "JPEG", "Small, with some loss"),
            ("avif", "AVIF", "Smallest for the same loss, and slow to write"),
        ],
        default="scene",
    )
    quality: IntProperty(
        name="Quality",
        description="Of JPEG and AVIF: more keeps more and takes more bytes",
        default=90,
        min=1,
        max=100,
    )
    single_file: BoolProperty(
        name="One File",
        description="Write one .html file that opens straight from the disk, instead of a folder for a web server",
        default=False,
    )


CLASSES = (SNERG_PG_scene,)
