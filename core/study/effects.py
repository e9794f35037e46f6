"""Which optional effects a capture, a field or a scene calls for: what decides each, what it costs, what leaving it out saves.

Nothing is decided here. A dataset is asked what training asks of it before it begins (field/decide.py), a field what its training
decided, a scene what its bake and its refining measured. What takes a training or a bake to know is said to be not measured yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..baking.bake import BakeSettings
from ..baking.supersampling import MIN_GAIN
from ..data.dataset import Dataset
from ..export.codecs import CodecSettings
from ..geometry.camera import Camera
from ..io.images import over, to_uint8
from ..nerf.field import Field
from ..progress import Progress, silent
from ..scene.scene import Scene
from ..training import decisions
from ..training.config import TrainSettings
from ..training.decisions import Decision
from ..training.losses import plain_colour
from ..training.silhouette import border_share

UNKNOWN = "not measured yet"
VIEW, ALPHA, BACKDROP, NDC = "View dependence", "Alpha", "Backdrop", "NDC"  # as training calls them
CLEAR, FILL, CULL, SAMPLES, REFINE = "Transparency", "Equation 9", "Visibility culling", "Samples a voxel", "Refining"
CODEC, LENS, INTRINSICS = "Lossy codec", "Distortion", "Several intrinsics"
PASSES = 0.1  # of the light that meets something, from which what passes it is more than what passes its outlines
WORTH = {  # what an effect costs, and what leaving it out saves, where nothing better is known
    VIEW: (
        "4 features beside a voxel's 4 other bytes, and a small network once a pixel.",
        "Half of the scene's memory, its feature pictures, and the network in the page.",
    ),
    ALPHA: (
        "An error of alpha beside that of colour in each training step.",
        "Nothing: without its hull more is sampled.",
    ),
    BACKDROP: ("Finding each image's outline once.", "Nothing: without their hull more is sampled."),
    NDC: ("Bending each ray once, and each pixel's depth back.", "That; but far and near then share voxels of one size."),
    "Hierarchical sampling": ("A second network, and its samples in each step.", "Both; thin things may then fall between samples."),
    "Disparity": ("Nothing: the same samples stand elsewhere.", "Nothing."),
    CLEAR: (
        "Samples and voxels behind what light passes through.",
        "Both: a ray ends with its light, and what no light reaches is culled.",
    ),
    FILL: ("A multiplication a pixel.", "That; light that baking lets through surfaces then stays."),
    CULL: ("A march from every training camera.", "That; but what no camera sees stays in the files and in memory."),
    SAMPLES: (
        "That many times the time of filling the atlas.",
        "All but one sample's share; fine detail is then aliased.",
    ),
    REFINE: ("A march of some pixels of every training view, and the fit.", "Both."),
    CODEC: ("Decibels, and time to write.", "Nothing lost; PNG and WebP take more bytes."),
    LENS: ("Straightening each training ray.", "Nothing: pictures and rays would not meet."),
    INTRINSICS: ("Nothing: each ray is its own camera's.", "Nothing."),
}


@dataclass(frozen=True)
class Effect:
    """An optional effect: what was decided and why, what it costs, and what leaving it out saves; sentences."""

    decision: Decision
    costs: str
    saves: str

    def to_json(self) -> dict[str, Any]:
        """JSON values: the decision's, "costs" and "saves"."""
        return {**self.decision.to_json(), "costs": self.costs, "saves": self.saves}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Effect:
        """Undo `to_json`."""
        rest = {name: item for name, item in value.items() if name not in ("costs", "saves")}
        return cls(Decision(**rest), value["costs"], value["saves"])


def of_dataset(data: Dataset, progress: Progress = silent) -> list[Effect]:
    """What a capture's images and cameras call for. Raises SnergError when an image cannot be read, Cancelled when `progress` does."""
    alpha, backdrop = _images(data, progress)
    ndc, _ = decisions.forward_facing("auto", data.cameras, data.points, data.bounds, bool(alpha.chosen))
    view = "Training takes the same steps with it and without it, and asks rays of views set aside which are better."
    return _rows(
        [
            unknown(VIEW, view),
            alpha,
            backdrop,
            ndc,
            _fill(bool(ndc.chosen)),
            lens(data.cameras),
            intrinsics(data.cameras),
            *_before_baking(True, len(data.cameras)),
        ]
    )


def of_field(field: Field) -> list[Effect]:
    """What training decided, as the field remembers it, and what that leaves to the bake."""
    told = [Decision(**value) for value in field.about.get("decisions", [])]
    known = {decision.effect for decision in told}
    settings = field.about.get("settings", {})
    said = "The settings said so." if settings else "The field was imported, which says nothing of why."
    missing = [
        Decision(VIEW, field.view, said, overridden=bool(settings)),
        unknown(ALPHA, "The field was imported, which says nothing of its images."),
        Decision(NDC, field.ndc is not None, said, overridden=bool(settings)),
    ]
    cameras = [lens(field.cameras), intrinsics(field.cameras)] if field.cameras else []
    before = _before_baking(field.network is not None, len(field.cameras))
    return _rows([*(d for d in missing if d.effect not in known), *told, _fill(field.ndc is not None), *cameras, *before])


def of_scene(snerg: Scene, codec: CodecSettings | None = None) -> list[Effect]:
    """What a baked scene carries, and what its bake and refining measured. codec: of its pictures, None where it is not stored so."""
    told = {value["effect"]: Decision(**value) for value in snerg.about.get("trained", {}).get("decisions", [])}
    carries = "The scene carries " + ("features and a network." if snerg.network is not None else "neither features nor a network.")
    view = Decision(VIEW, snerg.network is not None, carries)
    if VIEW in told:
        why = told[VIEW]
        view = replace(view, evidence=f"{carries} {why.evidence}", measured=why.measured, threshold=why.threshold)
    where = "The scene lies in " + ("the world." if snerg.ndc is None else "device coordinates.")
    ndc = told.get(NDC, Decision(NDC, snerg.ndc is not None, where))
    images = [told[name] for name in (ALPHA, BACKDROP) if name in told]
    return [
        _view_of(snerg, view),
        *_rows([*images, ndc, _fill_of(snerg)]),
        _clear_of(snerg),
        _cull_of(snerg),
        _samples_of(snerg),
        _refine_of(snerg),
        *_rows([_codec(codec)]),
    ]


def unknown(effect: str, evidence: str, threshold: float | None = None) -> Decision:
    """A decision that is still to be made; evidence: what makes it."""
    return Decision(effect, UNKNOWN, evidence, None, threshold)


def _rows(decisions: Sequence[Decision]) -> list[Effect]:
    return [Effect(decision, *WORTH.get(decision.effect, ("", ""))) for decision in decisions]


def _images(data: Dataset, progress: Progress) -> tuple[Decision, Decision]:
    """On alpha and on a backdrop, from all images, one at a time."""
    plain = plain_colour(TrainSettings().background)
    assert plain is not None
    alphas, shares, everywhere = [], [], True
    for index in range(len(data.views)):
        image = data.read(index)
        has = image.shape[-1] == 4
        everywhere &= has
        alphas.append(image[..., 3].reshape(-1) if has else np.full(image[..., 0].size, 255, np.uint8))
        shares.append(border_share(to_uint8(over(image)) if has else image, plain))
        progress((index + 1) / len(data.views), f"Reading image {index + 1} of {len(data.views)}")
    opacity = np.concatenate(alphas)
    pixels = np.broadcast_to(opacity[:, None], (len(opacity), 4))  # of which only alpha is looked at: no more memory than that
    alpha = decisions.transparency("auto", pixels, everywhere and bool((opacity < 255).any()))
    return alpha, decisions.backdrop("auto", shares, bool(alpha.chosen), TrainSettings().background)


def lens(cameras: Sequence[Camera]) -> Decision:
    """Whether lenses bend straight lines, as the source of the cameras says, and by how much at the pictures' edges."""
    bent = {(c.distortion, c.width, c.height, c.focal, c.centre): c for c in cameras if c.distortion is not None}
    if not bent:
        return Decision(LENS, False, "The source of the cameras names no lens that bends straight lines.", 0.0, 0.0)
    pixels = max(_bend(camera) for camera in bent.values())
    evidence = f"Lenses move what is at the edges by up to {pixels:.1f} pixels (any lens that the source names is followed)."
    return Decision(LENS, True, evidence, pixels, 0.0)


def _bend(camera: Camera) -> float:
    """How far, in pixels, the lens moves what is seen at the picture's edge, at most."""
    size = np.array([camera.width, camera.height])
    along, ends = np.linspace(0, 1, 17), (0, 1)
    edges = [np.stack(np.broadcast_arrays(x, y), axis=-1) * size for end in ends for x, y in ((along, end), (end, along))]
    flat = (np.concatenate(edges) - np.array(camera.centre)) / np.array(camera.focal)
    assert camera.distortion is not None
    return float(np.linalg.norm((camera.distortion.undistort(flat) - flat) * np.array(camera.focal), axis=-1).max())


def intrinsics(cameras: Sequence[Camera]) -> Decision:
    """Whether the cameras differ in more than where they stand."""
    kinds = len({(c.projection, c.width, c.height, c.focal, c.centre, c.distortion) for c in cameras})
    evidence = f"The {len(cameras)} cameras have {kinds} kind{'s' * (kinds > 1)} of size, focal length and lens between them."
    return Decision(INTRINSICS, kinds > 1, evidence, float(kinds), 2.0)


def _fill(forward: bool) -> Decision:
    if forward:
        return unknown(FILL, "The bake takes it where rays of the training cameras come nearer to the field's with it.")
    return Decision(FILL, False, "The scene is not forward-facing; as in the paper, it is for scenes that are (supplement C.3).")


def _fill_of(snerg: Scene) -> Decision:
    bake = snerg.about.get("bake", {})
    if errors := bake.get("holes"):
        evidence = f"Rays of the cameras are {errors['with']:.5f} away from the field's with it, {errors['without']:.5f} without it."
        return Decision(FILL, snerg.opacity_correction, evidence, errors["with"], errors["without"])
    if not snerg.opacity_correction and snerg.ndc is None:
        return _fill(False)
    told = bake.get("settings", {}).get("fill_holes") is not None
    why = "Its bake was told so." if told else "The scene does not say why; it is for forward-facing scenes (supplement C.3)."
    return Decision(FILL, snerg.opacity_correction, why, overridden=told)


def _before_baking(view_dependent: bool, cameras: int) -> list[Decision]:
    """What only a bake can tell, and what is known of it all the same."""
    marches = f"The bake marches from the {cameras} training cameras and counts what none of them sees"
    blind = Decision(CULL, False, "There are no cameras to see anything.")
    cull = unknown(CULL, f"{marches}.", BakeSettings().visibility_threshold) if cameras else blind
    clear = unknown(CLEAR, f"{marches}, and what light passes." if cameras else "There are no cameras to measure it from.", PASSES)
    gain = "The bake doubles them as long as short rays through its voxels come nearer to the field by more than the threshold."
    fit = unknown(REFINE, "Refining keeps the network that is better on a tenth of its pixels.", 0.0)
    diffuse = Decision(REFINE, False, "The field is diffuse: there is no network to refine.")
    return [clear, cull, unknown(SAMPLES, gain, MIN_GAIN), fit if view_dependent else diffuse, unknown(CODEC, _CODEC)]


_CODEC = "Nothing is lost unless --codec says so; 'snerg eval' of a scene stored each way tells what it costs."


def _codec(codec: CodecSettings | None) -> Decision:
    if codec is None or codec.lossless:
        return Decision(CODEC, False, f"The scene is stored {'without codec' if codec is None else 'as ' + codec.name.upper()}. {_CODEC}")
    return Decision(CODEC, codec.name, f"Stored at quality {codec.quality}, as its bake was told.", float(codec.quality), overridden=True)


def _view_of(snerg: Scene, decision: Decision) -> Effect:
    if snerg.network is None:
        return Effect(decision, f"Another {_megabytes(snerg.cells.nbytes)} of memory, and a network once a pixel.", "That is saved.")
    return Effect(
        decision,
        f"{_megabytes(snerg.cells.nbytes // 2)} of memory for features, and a network once a pixel.",
        f"Half of {_megabytes(snerg.cells.nbytes)} of memory, the feature pictures, and the network in the page.",
    )


def _clear_of(snerg: Scene) -> Effect:
    light = snerg.about.get("bake", {}).get("light")
    if not light:
        return Effect(unknown(CLEAR, "The scene does not say what becomes of light in it.", PASSES), *WORTH[CLEAR])
    evidence = f"{100 * light['passes']:.0f} % of the light that meets something passes it (under {100 * PASSES:.0f} % may be outlines "
    evidence += f"alone), and a ray takes samples along about {light['voxels']:.0f} voxels."
    return Effect(Decision(CLEAR, light["passes"] >= PASSES, evidence, light["passes"], PASSES), *WORTH[CLEAR])


def _cull_of(snerg: Scene) -> Effect:
    bake = snerg.about.get("bake", {})
    settings, voxels = bake.get("settings", {}), bake.get("voxels")
    threshold = settings.get("visibility_threshold")
    if not voxels:
        return Effect(unknown(CULL, "The scene does not say how it was baked.", threshold), *WORTH[CULL])
    if voxels["seen"] is None:
        return Effect(Decision(CULL, False, "The bake had no cameras, or was told to keep what none sees.", None, threshold), *WORTH[CULL])
    share = 1 - voxels["seen"] / max(voxels["held"], 1)
    evidence = f"No camera sees {100 * share:.0f} % of the {voxels['held']} voxels that hold something with a light of {threshold:g} left."
    costs = f"{bake['seconds']['visibility']:.1f} seconds of the bake."
    saves = f"That; the scene would then hold about {1 / max(1 - share, 1e-6):.1f} times as many voxels."
    return Effect(Decision(CULL, True, evidence, share, threshold), costs, saves)


def _samples_of(snerg: Scene) -> Effect:
    bake = snerg.about.get("bake", {})
    if "samples" not in bake:
        return Effect(unknown(SAMPLES, "The scene does not say how it was baked.", MIN_GAIN), *WORTH[SAMPLES])
    count, measured = bake["samples"], bake.get("samples_measured", [])
    seconds = bake["seconds"]["prefilter"]
    rest = seconds * (1 - 1 / count)
    worth = f"{seconds:.1f} seconds of the bake.", f"About {rest:.1f} of them, with 1 sample in place of {count}."
    if len(measured) < 2:
        told = "The bake was told to." if not measured else "There was nothing to measure."
        return Effect(Decision(SAMPLES, str(count), told, None, MIN_GAIN, overridden=not measured), *worth)
    errors = ", ".join(f"{m['samples']}: {m['error']:.4f}" for m in measured)
    last = 1 - measured[-1]["error"] / max(measured[-2]["error"], 1e-12)
    needed = f"doubling must take away {100 * MIN_GAIN:g} %, the last takes {100 * last:.1f} %"
    evidence = f"Errors of short rays by samples a voxel: {errors}; {needed}."
    return Effect(Decision(SAMPLES, str(count), evidence, last, MIN_GAIN), *worth)


def _refine_of(snerg: Scene) -> Effect:
    report = snerg.about.get("refine")
    if snerg.network is None:
        return Effect(Decision(REFINE, False, "The scene is diffuse: there is no network to refine."), "", "")
    if not report or "gain_db" not in report:
        why = report["skipped"] if report else "it was told not to, or the field has no dataset"
        return Effect(unknown(REFINE, f"The network is as it was trained ({why}).", 0.0), *WORTH[REFINE])
    gain, seconds = report["gain_db"], sum(report["seconds"].values())
    evidence = f"{report['psnr_before']:.2f} to {report['psnr_after']:.2f} dB on pixels kept out, {gain:+.2f} dB (any gain is kept)."
    return Effect(Decision(REFINE, gain > 0, evidence, gain, 0.0), f"{seconds:.1f} seconds after the bake.", f"{seconds:.1f} seconds.")


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.1f} MB"
