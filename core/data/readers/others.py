"""Recognises captures of tools whose own files are not read, and says how each exports one that is."""

from __future__ import annotations

from pathlib import Path

from ...errors import SnergError

NERFSTUDIO = "convert it with nerfstudio's 'ns-process-data {}' and give the folder with its transforms.json"
ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".gz", ".tgz")
RAW = (".usdz", ".ply", ".splat", ".spz", ".glb", ".obj")  # results without photographs

# (what must lie in the folder: patterns of which one is there; what it is; what to do)
FOLDERS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (("keyframes/cameras", "keyframes/corrected_cameras"), "a raw capture of Polycam", NERFSTUDIO.format("polycam")),
    (("EXR_RGBD/metadata.json", "rgbd", "*.r3d"), "a capture of Record3D", NERFSTUDIO.format("record3d")),
    (("*.psx", "*.files/project.zip"), "a project of Metashape", "export its cameras as COLMAP (File, Export, Export Cameras)"),
    (("*.rcproj", "*.rsproj"), "a project of RealityCapture", "export its registration as COLMAP"),
    (("cameras.sfm", "sfm.abc", "*.mg"), "a project of Meshroom", "export it as COLMAP with the node ExportColmap"),
    (("opensfm", "reconstruction.json"), "a reconstruction of OpenSfM or ODM", "export it with OpenSfM's 'export_colmap'"),
    (("database.db",), "a project of COLMAP without a model", "run COLMAP's mapper, so that there is sparse/0"),
    (("*.bundle.out", "bundle.out", "*.nvm"), "a model of Bundler or VisualSFM", "convert it with COLMAP's model_converter"),
    (("point_cloud/iteration_*",), "a result of Gaussian splatting", "give the capture that it was trained on, with its photographs"),
)


def check_supported(path: Path) -> None:
    """Raise SnergError, which names the tool and how to export a dataset from it, when a path that no reader knows is of such a tool.

    An archive is to be unpacked; BlenderNeRF leaves its dataset so.
    """
    if path.is_file():
        what = _file(path)
        if what is not None:
            raise SnergError(f"{path} is {what[0]}; {what[1]}.")
        return
    for patterns, what_it_is, advice in FOLDERS:
        if any(next(path.glob(pattern), None) is not None for pattern in patterns):
            raise SnergError(f"{path} is {what_it_is}, which is not read; {advice}.")
    for pattern in ("*.xml", "*.csv"):
        for file in sorted(path.glob(pattern)):
            if (found := _file(file)) is not None:
                raise SnergError(f"{path} has only {file.name}, {found[0]}; {found[1]}.")


def _file(path: Path) -> tuple[str, str] | None:
    """(what a file is, what to do) for a file of a known tool; None for others."""
    suffix = path.suffix.lower()
    if suffix in ARCHIVES:
        return "an archive", "unpack it and give the folder that comes out"
    if suffix in (".xml", ".csv"):
        with open(path, "rb") as file:
            head = file.read(4096)
        if suffix == ".xml" and b"<document" in head and b"<chunk" in head:
            return "cameras of Metashape", "export them as COLMAP instead (File, Export, Export Cameras), or " + NERFSTUDIO.format(
                "metashape"
            )
        if suffix == ".csv" and head.lstrip(b"\xef\xbb\xbf").startswith(b"#name,"):
            return "a registration of RealityCapture", "export it as COLMAP instead, or " + NERFSTUDIO.format("realitycapture")
    if suffix in RAW:
        return "a result without photographs", "give the capture that it was made from"
    return None
