"""Recognises captures of tools whose own files are not read, and says how each exports one that is."""

from __future__ import annotations

from pathlib import Path

from ...errors import SnergError

ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".r3d")
RAW = (".usdz", ".ply", ".splat", ".spz", ".ksplat", ".sog", ".glb", ".gltf", ".obj", ".fbx", ".las", ".laz", ".e57")
UNDISTORTED = "export it as COLMAP, or its cameras as XML (File, Export, Export Cameras)"
REGISTRATION = "export its registration as 'Internal/External camera parameters' (.csv), as metadata (XMP) or as COLMAP"
EXPORT_COLMAP = "export it as COLMAP with the node ExportColmap"
OPENSFM = "export it with OpenSfM's 'export_colmap', or convert it with nerfstudio's 'ns-process-data odm'"
BUNDLER = "export it as Bundler (bundle.out with its list of photographs) or as COLMAP"
OPENMVG = "export it as COLMAP with openMVG_main_openMVG2Colmap"
PIX4D = "export it as Bundler (bundle.out with its list of photographs) or, from PIX4Dmatic, as COLMAP"
MORE_FRAMES = "extract its frames and find their cameras, for instance with nerfstudio's 'ns-process-data video'"

# A file by its suffix: (what it is, what to do).
FILES: dict[str, tuple[str, str]] = {
    **dict.fromkeys(ARCHIVES, ("an archive", "unpack it and give the folder that comes out")),
    **dict.fromkeys(RAW, ("a result without photographs", "give the capture that it was made from")),
    **dict.fromkeys((".psx", ".psz"), ("a project of Metashape", UNDISTORTED)),
    **dict.fromkeys((".rcproj", ".rsproj", ".rcalign"), ("a project of RealityCapture (RealityScan)", REGISTRATION)),
    **dict.fromkeys((".mg", ".sfm"), ("a project of Meshroom", EXPORT_COLMAP)),
    ".abc": ("an Alembic file, as Meshroom writes it", EXPORT_COLMAP),
    **dict.fromkeys((".p4d", ".p4m", ".bpj"), ("a project of Pix4D", PIX4D)),
    ".nvm": ("a model of VisualSFM", BUNDLER),
    **dict.fromkeys((".mp4", ".mov", ".avi", ".mkv", ".webm", ".insv"), ("a video", MORE_FRAMES)),
    ".3dz": ("a project of 3DF Zephyr", BUNDLER),
}

# (what must lie in the folder: patterns of which one is there; what it is; what to do)
FOLDERS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (("keyframes/images", "keyframes/depth"), "a capture of Polycam without its cameras", "export its raw data (developer mode) again"),
    (("EXR_RGBD", "rgbd"), "a recording of Record3D without its metadata", "export it as 'EXR + RGB' again"),
    (("*.r3d",), "a recording of Record3D", "unpack the .r3d, which is a zip archive, or export it as 'EXR + RGB'"),
    (("*.psx", "*.psz", "*.files/project.zip"), "a project of Metashape", UNDISTORTED),
    (("*.rcproj", "*.rsproj"), "a project of RealityCapture (RealityScan)", REGISTRATION),
    (("cameras.sfm", "sfm.abc", "*.sfm", "*.mg"), "a project of Meshroom", EXPORT_COLMAP),
    (("sfm_data.json", "sfm_data.bin", "*/sfm_data.json", "*/sfm_data.bin"), "a reconstruction of OpenMVG", OPENMVG),
    (("opensfm", "reconstruction.json"), "a reconstruction of OpenSfM or ODM", OPENSFM),
    (("*.p4d", "*.p4m", "*_calibrated_camera_parameters.txt", "params/*_calibrated_camera_parameters.txt"), "a project of Pix4D", PIX4D),
    (("database.db",), "a project of COLMAP without a model", "run COLMAP's mapper, so that there is sparse/0"),
    (("*.nvm",), "a model of VisualSFM", BUNDLER),
    (("point_cloud/iteration_*",), "a result of Gaussian splatting", "give the capture that it was trained on, with its photographs"),
    (("*.mvs", "scene.mvs"), "a scene of OpenMVS", "give the capture that it was made from"),
)


def check_supported(path: Path) -> None:
    """Raise SnergError, which names the tool and how to export a dataset from it, when a path that no reader knows is of such a tool.

    An archive is to be unpacked; BlenderNeRF leaves its dataset so.
    """
    if path.is_file():
        what = _file(path)
        if what is not None:
            raise SnergError(f"{path} is {what[0]}, which is not read; {what[1]}.")
        return
    for patterns, what_it_is, advice in FOLDERS:
        if any(next(path.glob(pattern), None) is not None for pattern in patterns):
            raise SnergError(f"{path} is {what_it_is}, which is not read; {advice}.")


def _file(path: Path) -> tuple[str, str] | None:
    """(what a file is, what to do) for a file of a known tool; None for others."""
    return FILES.get(path.suffix.lower())


def check_json(path: Path, value: object) -> None:
    """Raise SnergError, which names the tool, when a JSON file is of OpenMVG, Meshroom, OpenSfM or Gaussian splatting."""
    keys = value[0] if isinstance(value, list) and value else value
    if not isinstance(keys, dict):
        return
    if "sfm_data_version" in keys:
        raise SnergError(f"{path} is a reconstruction of OpenMVG, which is not read; {OPENMVG}.")
    if "views" in keys and "intrinsics" in keys:
        raise SnergError(f"{path} is a project of Meshroom, which is not read; {EXPORT_COLMAP}.")
    if "img_name" in keys:
        raise SnergError(f"{path} is of cameras of Gaussian splatting without photographs; put these into a folder 'images' beside it.")
    if "shots" in keys:
        raise SnergError(f"{path} is a reconstruction of OpenSfM or ODM, which is not read; {OPENSFM}.")
