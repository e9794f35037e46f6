"""The optional effects of a capture, a field or a scene: whether each is used, the evidence, its cost, and what leaving it out saves.

This file decides nothing. The effects of a dataset are those that training would decide before it begins (training/decisions.py), those of
a field are its training's decisions, those of a scene are what its bake and fine-tuning measured. Other effects are 'not measured yet'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..baking.bake import BakeSettings
from ..baking.supersampling import MIN_GAIN
from ..baking.thin_fog import MAX_GRAIN
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
from ..units import duration, file_size

UNKNOWN = "not measured yet"
VIEW, ALPHA, BACKDROP, NDC = "View dependence", "Alpha", "Backdrop", "NDC"  # as training calls them
CLEAR, FILL, CULL, SAMPLES, REFINE = "Transparency", "Equation 9", "Visibility culling", "Samples a voxel", "Refining"
CODEC, LENS, INTRINSICS, FOG = "Lossy codec", "Distortion", "Several intrinsics", "Thin fog"
TRANSPARENT = 0.1  # mean transmittance of rays that hit something, above which more than the outlines is transparent
COSTS = {  # of an effect, and of leaving it out, where they are not measured
    VIEW: (
        "4 bytes of features beside a voxel's 4 other bytes, and a small network evaluated once a pixel.",
        "Half of the scene's memory, its feature images, and the network in the page.",
    ),
    ALPHA: (
        "A loss of alpha beside that of colour in each training step.",
        "Nothing: without its visual hull, training takes more samples.",
    ),
    BACKDROP: ("Finding each image's outline once.", "Nothing: without the visual hull, training takes more samples."),
    NDC: ("A transformation of each ray and of each pixel's depth.", "That; but near and far voxels then have the same size."),
    "Hierarchical sampling": ("A second network, and its samples in each step.", "Both; thin objects may then fall between samples."),
    "Disparity": ("Nothing: the same number of samples is placed differently.", "Nothing."),
    CLEAR: (
        "Samples and voxels behind transparent surfaces.",
        "Both: a ray ends where its transmittance is low, and voxels behind it are culled.",
    ),
    FILL: ("A multiplication a pixel.", "That; surfaces that baking makes too transparent stay so."),
    CULL: ("A march from every training camera.", "That; but voxels that no camera sees stay in the files and in memory."),
    SAMPLES: (
        "The time of filling the atlas, times the number of samples.",
        "All of it but one sample's share; fine detail is then aliased.",
    ),
    REFINE: ("A march of some pixels of every training view, and the fit of the network.", "Both."),
    FOG: (
        "About 0.25 bytes a stored value of fog in place of 0.03 to 0.25, and eight texels read by the page for each that its card would "
        "interpolate.",
        "That; fog is then grainy.",
    ),
    CODEC: ("Decibels, and time to write.", "Quality: PNG, WebP and JPEG XL are lossless, and take more bytes."),
    LENS: ("Undistorting each training ray.", "Nothing: rays would not match the images."),
    INTRINSICS: ("Nothing: each ray has the intrinsics of its camera.", "Nothing."),
}


@dataclass(frozen=True)
class Effect:
    """An optional effect."""

    decision: Decision  # whether it is used, and the evidence
    costs: str  # a sentence
    saves: str  # what leaving it out saves, a sentence

    def to_json(self) -> dict[str, Any]:
        """JSON values: the decision's, "costs" and "saves"."""
        return {**self.decision.to_json(), "costs": self.costs, "saves": self.saves}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Effect:
        """The effect that `to_json` wrote."""
        rest = {name: item for name, item in value.items() if name not in ("costs", "saves")}
        return cls(Decision(**rest), value["costs"], value["saves"])


def of_dataset(data: Dataset, progress: Progress = silent) -> list[Effect]:
    """The effects of a capture. Raises SnergError when an image cannot be read, Cancelled when `progress` does."""
    alpha, backdrop = _images(data, progress)
    ndc, _ = decisions.forward_facing("auto", data.cameras, data.points, data.bounds, bool(alpha.chosen))
    view = "Training runs the same number of steps with and without it, and compares them on validation views."
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
    """The effects of a field: the decisions of its training, and those that its bake will make."""
    decided = [Decision(**value) for value in field.about.get("decisions", [])]
    known = {decision.effect for decision in decided}
    settings = field.about.get("settings", {})
    why = "It was set." if settings else "The field was imported, and does not say why."
    missing = [
        Decision(VIEW, field.view, why, overridden=bool(settings)),
        unknown(ALPHA, "The field was imported, and does not say which images it was trained on."),
        Decision(NDC, field.ndc is not None, why, overridden=bool(settings)),
    ]
    cameras = [lens(field.cameras), intrinsics(field.cameras)] if field.cameras else []
    before = _before_baking(field.network is not None, len(field.cameras))
    return _rows([*(d for d in missing if d.effect not in known), *decided, _fill(field.ndc is not None), *cameras, *before])


def of_scene(snerg: Scene, codec: CodecSettings | None = None) -> list[Effect]:
    """The effects of a baked scene: what it stores, and what its bake and fine-tuning measured. codec: of its images, None for floats."""
    decided = {value["effect"]: Decision(**value) for value in snerg.about.get("trained", {}).get("decisions", [])}
    stores = "The scene stores " + ("features and a network." if snerg.network is not None else "neither features nor a network.")
    view = Decision(VIEW, snerg.network is not None, stores)
    if VIEW in decided:
        why = decided[VIEW]
        view = replace(view, evidence=f"{stores} {why.evidence}", measured=why.measured, threshold=why.threshold)
    where = "The scene is in " + ("world coordinates." if snerg.ndc is None else "normalised device coordinates.")
    ndc = decided.get(NDC, Decision(NDC, snerg.ndc is not None, where))
    images = [decided[name] for name in (ALPHA, BACKDROP) if name in decided]
    return [
        _view_of(snerg, view),
        *_rows([*images, ndc, _fill_of(snerg), *_fog_of(snerg)]),
        _clear_of(snerg),
        _cull_of(snerg),
        _samples_of(snerg),
        _refine_of(snerg),
        *_rows([_codec(codec)]),
    ]


def unknown(effect: str, evidence: str, threshold: float | None = None) -> Decision:
    """A decision that is not made yet. evidence: what will decide it."""
    return Decision(effect, UNKNOWN, evidence, None, threshold)


def _rows(decisions: Sequence[Decision]) -> list[Effect]:
    return [Effect(decision, *COSTS.get(decision.effect, ("", ""))) for decision in decisions]


def _images(data: Dataset, progress: Progress) -> tuple[Decision, Decision]:
    """The decisions on alpha and on a backdrop, from all images, which are read one at a time."""
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
    pixels = np.broadcast_to(opacity[:, None], (len(opacity), 4))  # a view without memory of its own: only alpha is used
    alpha = decisions.transparency("auto", pixels, everywhere and bool((opacity < 255).any()))
    return alpha, decisions.backdrop("auto", shares, bool(alpha.chosen), TrainSettings().background)


def lens(cameras: Sequence[Camera]) -> Decision:
    """Whether the cameras have lens distortion, and by how many pixels at the edges of the images."""
    bent = {(c.distortion, c.width, c.height, c.focal, c.centre): c for c in cameras if c.distortion is not None and not c.is_wide}
    if not bent:
        return Decision(LENS, False, "The source of the cameras gives no lens distortion.", 0.0, 0.0)
    pixels = max(_bend(camera) for camera in bent.values())
    evidence = f"Lens distortion moves points at the images' edges by up to {pixels:.1f} pixels (any distortion is followed)."
    return Decision(LENS, True, evidence, pixels, 0.0)


def _bend(camera: Camera) -> float:
    """The largest displacement by the lens distortion along the image's edges, in pixels."""
    size = np.array([camera.width, camera.height])
    along, ends = np.linspace(0, 1, 17), (0, 1)
    edges = [np.stack(np.broadcast_arrays(x, y), axis=-1) * size for end in ends for x, y in ((along, end), (end, along))]
    flat = (np.concatenate(edges) - np.array(camera.centre)) / np.array(camera.focal)
    assert camera.distortion is not None
    return float(np.linalg.norm((camera.distortion.undistort(flat) - flat) * np.array(camera.focal), axis=-1).max())


def intrinsics(cameras: Sequence[Camera]) -> Decision:
    """Whether the cameras differ in more than their poses."""
    kinds = len({(c.projection, c.width, c.height, c.focal, c.centre, c.distortion) for c in cameras})
    evidence = f"The {len(cameras)} cameras have {kinds} kind{'s' * (kinds > 1)} of size, focal length and lens between them."
    return Decision(INTRINSICS, kinds > 1, evidence, float(kinds), 2.0)


def _fill(forward: bool) -> Decision:
    if forward:
        return unknown(FILL, "The bake uses it where rays of the training cameras are closer to the field's with it.")
    return Decision(FILL, False, "The scene is not forward-facing; as in the paper, it is for forward-facing scenes (supplement C.3).")


def _fill_of(snerg: Scene) -> Decision:
    bake = snerg.about.get("bake", {})
    if errors := bake.get("holes"):
        evidence = f"Rays of the cameras differ from the field's by {errors['with']:.5f} with it, by {errors['without']:.5f} without it."
        return Decision(FILL, snerg.opacity_correction, evidence, errors["with"], errors["without"])
    if not snerg.opacity_correction and snerg.ndc is None:
        return _fill(False)
    was_set = bake.get("settings", {}).get("fill_holes") is not None
    why = "It was set for the bake." if was_set else "The scene does not say why; it is for forward-facing scenes (supplement C.3)."
    return Decision(FILL, snerg.opacity_correction, why, overridden=was_set)


def _fog_of(snerg: Scene) -> list[Decision]:
    """Of a scene of thin fog alone: others carry nothing of it, not even a measurement."""
    if not snerg.square_roots:
        return []
    grain = snerg.about.get("bake", {}).get("thin_fog", {}).get("grain")
    measured = "" if grain is None else f": even levels would change rays through it by up to {grain:.1f} of 255"
    return [Decision(FOG, True, f"The scene stores square roots of its values{measured}.", grain, MAX_GRAIN)]


def _before_baking(view_dependent: bool, cameras: int) -> list[Decision]:
    """The effects that a bake decides, with what will decide them."""
    marches = f"The bake marches from the {cameras} training cameras and counts the voxels that none of them sees"
    blind = Decision(CULL, False, "There are no training cameras.")
    cull = unknown(CULL, f"{marches}.", BakeSettings().visibility_threshold) if cameras else blind
    clear = unknown(
        CLEAR, f"{marches}, and measures the transmittance." if cameras else "There are no cameras to measure it from.", TRANSPARENT
    )
    gain = "The bake doubles them while that reduces the error of short rays through its voxels by more than the threshold."
    fit = unknown(REFINE, "Fine-tuning keeps the network that is better on a held-out tenth of its pixels.", 0.0)
    diffuse = Decision(REFINE, False, "The field is diffuse: there is no network to fine-tune.")
    return [clear, cull, unknown(SAMPLES, gain, MIN_GAIN), fit if view_dependent else diffuse, unknown(CODEC, _CODEC)]


_CODEC = "The default codec is lossless; 'snerg eval' of a scene stored with each codec measures the loss."


def _codec(codec: CodecSettings | None) -> Decision:
    if codec is not None and codec.half_features:
        text = "Stored as {}, as was set: a feature for each 2 x 2 x 2 voxels."
        return Decision(CODEC, codec.name, text.format(codec.text), 2.0, overridden=True)
    if codec is None or codec.lossless:
        return Decision(CODEC, False, f"The scene is stored {'without codec' if codec is None else 'as ' + codec.name.upper()}. {_CODEC}")
    return Decision(CODEC, codec.name, f"Stored at quality {codec.quality}, which was set.", float(codec.quality), overridden=True)


def _view_of(snerg: Scene, decision: Decision) -> Effect:
    if snerg.network is None:
        return Effect(decision, f"Another {file_size(snerg.cells.nbytes)} of memory, and a network once a pixel.", "That.")
    return Effect(
        decision,
        f"{file_size(snerg.cells.nbytes // 2)} of memory for features, and a network once a pixel.",
        f"Half of {file_size(snerg.cells.nbytes)} of memory, the feature images, and the network in the page.",
    )


def _clear_of(snerg: Scene) -> Effect:
    light = snerg.about.get("bake", {}).get("light")
    if not light:
        return Effect(unknown(CLEAR, "The scene has no measurement of transmittance.", TRANSPARENT), *COSTS[CLEAR])
    evidence = f"The mean transmittance of rays that hit something is {100 * light['passes']:.0f} % (outlines alone may give up to "
    evidence += f"{100 * TRANSPARENT:.0f} %), and a ray takes samples along about {light['voxels']:.0f} voxels."
    return Effect(Decision(CLEAR, light["passes"] >= TRANSPARENT, evidence, light["passes"], TRANSPARENT), *COSTS[CLEAR])


def _cull_of(snerg: Scene) -> Effect:
    bake = snerg.about.get("bake", {})
    settings, voxels = bake.get("settings", {}), bake.get("voxels")
    threshold = settings.get("visibility_threshold")
    if not voxels:
        return Effect(unknown(CULL, "The scene has no report of its bake.", threshold), *COSTS[CULL])
    if voxels["seen"] is None:
        return Effect(Decision(CULL, False, "The bake had no cameras, or culling was off.", None, threshold), *COSTS[CULL])
    share = 1 - voxels["seen"] / max(voxels["held"], 1)
    evidence = f"No camera sees {100 * share:.0f} % of the {voxels['held']} occupied voxels with a transmittance of {threshold:g} or more."
    costs = f"{duration(bake['seconds']['visibility'])} of the bake."
    saves = f"That; the scene would then hold about {1 / max(1 - share, 1e-6):.1f} times as many voxels."
    return Effect(Decision(CULL, True, evidence, share, threshold), costs, saves)


def _samples_of(snerg: Scene) -> Effect:
    bake = snerg.about.get("bake", {})
    if "samples" not in bake:
        return Effect(unknown(SAMPLES, "The scene has no report of its bake.", MIN_GAIN), *COSTS[SAMPLES])
    count, measured = bake["samples"], bake.get("samples_measured", [])
    seconds = bake["seconds"]["prefilter"]
    rest = seconds * (1 - 1 / count)
    worth = f"{duration(seconds)} of the bake.", f"About {duration(rest)} of that, with 1 sample in place of {count}."
    if len(measured) < 2:
        why = "It was set for the bake." if not measured else "There was nothing to measure."
        return Effect(Decision(SAMPLES, str(count), why, None, MIN_GAIN, overridden=not measured), *worth)
    errors = ", ".join(f"{m['samples']}: {m['error']:.4f}" for m in measured)
    last = 1 - measured[-1]["error"] / max(measured[-2]["error"], 1e-12)
    needed = f"doubling must reduce it by {100 * MIN_GAIN:g} %, the last does by {100 * last:.1f} %"
    evidence = f"Errors of short rays by samples a voxel: {errors}; {needed}."
    return Effect(Decision(SAMPLES, str(count), evidence, last, MIN_GAIN), *worth)


def _refine_of(snerg: Scene) -> Effect:
    report, fitted = snerg.about.get("refine"), snerg.about.get("fit") or {}
    if "gain_db" in fitted:
        gain, seconds = fitted["gain_db"], sum(fitted["seconds"].values())
        evidence = f"Voxels and network were fitted: {fitted['psnr_before']:.2f} to {fitted['psnr_after']:.2f} dB on views kept out."
        return Effect(Decision(REFINE, gain > 0, evidence, gain, 0.0), f"{seconds:.1f} seconds after the bake.", f"{seconds:.1f} seconds.")
    if snerg.network is None:
        return Effect(Decision(REFINE, False, "The scene is diffuse: there is no network to fine-tune."), "", "")
    if not report or "gain_db" not in report:
        why = report["skipped"] if report else "fine-tuning was off, or the field has no dataset"
        return Effect(unknown(REFINE, f"The network is not fine-tuned ({why}).", 0.0), *COSTS[REFINE])
    gain, seconds = report["gain_db"], sum(report["seconds"].values())
    evidence = f"{report['psnr_before']:.2f} to {report['psnr_after']:.2f} dB on held-out pixels, {gain:+.2f} dB (any gain is kept)."
    return Effect(Decision(REFINE, gain > 0, evidence, gain, 0.0), f"{duration(seconds)} after the bake.", f"{duration(seconds)}.")
