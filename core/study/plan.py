"""What a study tries: configurations, and the knobs by which they differ from the usual one."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..baking.bake import AUTO_SUPERSAMPLING, BAKE_VERSION, BakeSettings
from ..errors import SnergError
from ..export.codecs import CodecSettings
from ..export.scene_files import PNG
from ..io.files import json_bytes
from ..rendering.render import MarchSettings

SHARES = (0.25, 0.375, 0.5, 0.75)  # of the usual resolution, coarse first
PAGE_STOP = 1 / 1024  # light at which a ray of the web page ends (viewer/src/march.glsl)


@dataclass(frozen=True)
class StudySettings:
    """minutes: the time that measuring may take; what is left over is told, and done when the study goes on. resolution: the usual
    one. views: held-out views at most; repeats: how often what is timed is done (medians are kept). box: of the bakes.
    paper: whether fields of other kinds are trained for the paper's tables.
    """

    minutes: float = 30.0
    resolution: int = BakeSettings.resolution
    views: int = 20
    repeats: int = 1
    box: Path | None = None
    seed: int = 0
    paper: bool = False


@dataclass(frozen=True)
class Config:
    """Everything that a scene is made and shown with. field: the name of its field among the study's, '' where there is one alone.
    page: shown as the web page shows it, in 8 bits a value and with its rays' end."""

    bake: BakeSettings = BakeSettings()
    refine: bool = True
    codec: CodecSettings = PNG
    march: MarchSettings = MarchSettings()
    field: str = ""
    page: bool = False

    @property
    def key(self) -> str:
        """A short name, another for another configuration."""
        return hashlib.sha256(json_bytes(self.to_json())).hexdigest()[:10]

    @property
    def baked(self) -> str:
        """`key` of what is baked: the same for what differs only in what comes after that."""
        return Config(bake=self.bake, field=self.field).key

    def to_json(self) -> dict[str, Any]:
        """JSON values: only what changes a result."""
        march = {"tolerance": self.march.tolerance, "stop_transmittance": self.march.stop_transmittance}
        march |= {"per_sample_network": self.march.per_sample_network}
        rest = {"refine": self.refine, "codec": self.codec.to_json(), "field": self.field, "page": self.page}
        return {"bake": asdict(self.bake), "version": BAKE_VERSION, "march": march, **rest}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Config:
        """Undo `to_json`. Raises KeyError or TypeError where it is something else."""
        return cls(
            BakeSettings(**value["bake"]),
            value["refine"],
            CodecSettings.from_json(value["codec"]),
            MarchSettings(**value["march"]),
            value["field"],
            value["page"],
        )


@dataclass(frozen=True)
class Step:
    """A configuration of a study. knobs: (knob, its value here, for people) of each path that it is on."""

    config: Config
    knobs: tuple[tuple[str, str], ...]

    @property
    def text(self) -> str:
        """For people."""
        return "; ".join(f"{knob}: {value}" for knob, value in self.knobs)


RESOLUTION, SAMPLES, CODEC, TOLERANCE = "resolution", "samples a voxel", "codec", "tolerance"
ALPHA, VISIBILITY, BITS, NETWORK, REFINE, TRAINING = "alpha threshold", "visibility threshold", "bits", "network", "refining", "training"
WATERFALL = "stages"
STAGES = ("grid", "culling", "quantising", "refining", "codec", "web page")


def steps(usual: Config, features: bool, cameras: bool, refinable: bool, codecs: Sequence[str], fields: Sequence[str] = ()) -> list[Step]:
    """What to try, in this order: coarse resolutions first, then the usual configuration, then what is had from it without another
    bake, then one knob after another, then coarse resolutions stored and marched otherwise.

    features: whether the field is view-dependent; cameras: whether it knows any; refinable: whether its images are there; codecs:
    those that can be written here; fields: names of fields of other lengths of training. A configuration stands once, on all its paths.
    """
    found: dict[str, Step] = {}
    usual = usual if refinable else replace(usual, refine=False)
    for config, knob, value in _tried(usual, features, cameras, refinable, codecs, fields):
        knobs = found[config.key].knobs if config.key in found else ()
        found[config.key] = Step(config, knobs if (knob, value) in knobs else (*knobs, (knob, value)))
    return list(found.values())


def _tried(
    usual: Config, features: bool, cameras: bool, refinable: bool, codecs: Sequence[str], fields: Sequence[str]
) -> Iterator[tuple[Config, str, str]]:
    size, baked = usual.bake.resolution, usual.bake
    coarse = [with_bake(usual, resolution=max(2, round(share * size))) for share in SHARES]
    for config in coarse:
        yield config, RESOLUTION, f"{config.bake.resolution} voxels"
    yield usual, RESOLUTION, f"{size} voxels"
    stored = [PNG, *_codecs(codecs)]
    for codec in stored:
        if codec.lossless:
            yield replace(usual, codec=codec), CODEC, told(codec)
    for codec in stored:
        if not codec.lossless:
            yield usual, quality_of(codec), "lossless"
            yield replace(usual, codec=codec), quality_of(codec), str(codec.quality)
    for tolerance in sorted({usual.march.tolerance, 1e-3, 1e-2, 3e-2}):
        yield replace(usual, march=replace(usual.march, tolerance=tolerance)), TOLERANCE, f"{tolerance:g}"
    if features:
        yield usual, NETWORK, "once a pixel"
        yield replace(usual, march=replace(usual.march, per_sample_network=True)), NETWORK, "at every sample"
    if refinable:
        yield usual, REFINE, "refined"
        yield replace(usual, refine=False), REFINE, "not refined"
    yield from _stages(usual, cameras, refinable, stored)
    if features:
        yield replace(with_bake(usual, network=False), refine=False), NETWORK, "none"
    yield usual, BITS, "8"
    yield with_bake(usual, quantise=False), BITS, "32"
    yield usual, SAMPLES, "auto" if baked.samples == AUTO_SUPERSAMPLING else str(baked.samples)
    for count in sorted({1, 2, 4, 8} - {baked.samples}):
        yield with_bake(usual, samples=count), SAMPLES, str(count)
    for alpha in sorted({baked.alpha_threshold, 0.001, 0.02, 0.1}):
        yield with_bake(usual, alpha_threshold=alpha), ALPHA, f"{alpha:g}"
    if cameras:
        for seen in sorted({baked.visibility_threshold, 0.001, 0.1}):
            yield with_bake(usual, visibility_threshold=seen), VISIBILITY, f"{seen:g}"
        yield with_bake(usual, visibility=False), VISIBILITY, "nothing culled"
    for name in fields:
        yield replace(usual, field=name), TRAINING, name
    for config in reversed(coarse):
        for codec in stored[1:]:
            yield replace(config, codec=codec), f"{RESOLUTION}, {told(codec)}", f"{config.bake.resolution} voxels"
        marched = replace(config, march=replace(config.march, tolerance=1e-2))
        yield marched, f"{RESOLUTION}, tolerance 0.01", f"{config.bake.resolution} voxels"


def _stages(usual: Config, cameras: bool, refinable: bool, stored: Sequence[CodecSettings]) -> Iterator[tuple[Config, str, str]]:
    """From the field to the web page, one loss after another (see STAGES)."""
    plain = replace(usual, refine=False)
    yield with_bake(plain, quantise=False, visibility=False), WATERFALL, STAGES[0]
    if cameras:
        yield with_bake(plain, quantise=False), WATERFALL, STAGES[1]
    yield plain, WATERFALL, STAGES[2]
    if refinable:
        yield usual, WATERFALL, STAGES[3]
    lossy = next((codec for codec in stored if not codec.lossless and codec.name != "h264"), PNG)
    yield replace(usual, codec=lossy), WATERFALL, STAGES[4]
    shown = replace(usual.march, stop_transmittance=PAGE_STOP)
    yield replace(usual, codec=lossy, march=shown, page=True), WATERFALL, STAGES[5]


def _codecs(names: Sequence[str]) -> Iterator[CodecSettings]:
    for name in names:
        if CodecSettings(name).lossless:
            yield CodecSettings(name)
        else:
            yield from (CodecSettings(name, quality) for quality in (90, 70, 50))


def with_bake(config: Config, **changes: Any) -> Config:
    """A configuration that is baked otherwise."""
    return replace(config, bake=replace(config.bake, **changes))


def quality_of(codec: CodecSettings) -> str:
    """The knob that is a lossy codec's quality."""
    return f"{codec.name.upper()} quality"


def told(codec: CodecSettings) -> str:
    """A codec for people."""
    return codec.name.upper() + ("" if codec.lossless else f" {codec.quality}")


def available(names: Sequence[str]) -> list[str]:
    """Those codecs that can be written here."""
    found = []
    for name in names:
        try:
            CodecSettings(name).check()
        except SnergError:
            continue
        found.append(name)
    return found
