"""What a study measures: the baseline configuration, and configurations that differ from it in one parameter."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..baking.bake import AUTO_SUPERSAMPLING, BAKE_VERSION, BakeSettings
from ..baking.finish import Finishing
from ..errors import SnergError
from ..export.codecs import PNG, CodecSettings
from ..io.json_files import json_bytes
from ..io.settings import check_number, check_whole
from ..rendering.render import MarchSettings
from ..scene.voxel_grid import MAX_RESOLUTION

COARSE_SHARES = (0.25, 0.375, 0.5, 0.75)  # of the baseline's resolution, measured first because they are quick
PAGE_STOP = 1 / 1024  # transmittance at which a ray of the web page ends (march.glsl of the viewer)


@dataclass(frozen=True)
class StudySettings:
    """Settings of a study. Raises SnergError for values out of range."""

    minutes: float = 30.0  # time limit; a study that is started again measures what was left out
    resolution: int = BakeSettings.resolution  # voxels along the longest side, of the baseline
    views: int = 20  # held-out views to measure on, at most
    repeats: int = 1  # of each timing; the median counts
    box: Path | None = None  # JSON file of the bakes' box; the field's whole domain when None
    seed: int = 0  # of bakes and trainings
    paper: bool = False  # whether to train fields of other kinds for the paper's tables

    def __post_init__(self) -> None:
        check_number("The time limit of a study, in minutes,", self.minutes, 0, 1e9)
        check_whole("The resolution of a study", self.resolution, 2, MAX_RESOLUTION)
        for name in ("views", "repeats"):
            check_whole(f"The study's number of {name}", getattr(self, name), 1, 2**31)
        check_whole("The seed of a study", self.seed, 0, 2**63 - 1)


@dataclass(frozen=True)
class Part:
    """One of `count` parts of a study that are measured apart, on one machine or several. number: from 1."""

    number: int
    count: int

    @classmethod
    def read(cls, text: str) -> Part:
        """The part that '2/8' names. Raises ValueError on anything else."""
        number, count = (int(word) for word in text.split("/"))
        if not 1 <= number <= count:
            raise ValueError(f"{text} is no part: the first number counts from 1 to the second")
        return cls(number, count)

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @property
    def name(self) -> str:
        """'2-of-8', as part of a file's name."""
        return f"{self.number}-of-{self.count}"

    def share(self, plan: Sequence[PlanStep]) -> list[PlanStep]:
        """The steps of a plan that the part measures, in order.

        Steps that share a bake are in one part, so that each bake is made once. The groups go, the largest first, to the part that has
        least: a share depends on the plan alone, and every machine finds the same. A bake counts as one step more.
        """
        groups: dict[str, list[PlanStep]] = {}
        for step in plan:
            groups.setdefault(step.config.baked, []).append(step)
        loads, chosen = [0] * self.count, set()
        for baked, steps in sorted(groups.items(), key=lambda item: -len(item[1])):
            lightest = loads.index(min(loads))
            loads[lightest] += 1 + len(steps)
            if lightest == self.number - 1:
                chosen.add(baked)
        return [step for step in plan if step.config.baked in chosen]


@dataclass(frozen=True)
class Configuration:
    """Everything that a scene is made and shown with."""

    bake: BakeSettings = BakeSettings()
    refine: bool = True  # whether the view-dependence network is fine-tuned
    codec: CodecSettings = PNG
    march: MarchSettings = MarchSettings()
    field: str = ""  # name of the field among the study's; '' where there is one
    page: bool = False  # whether it is shown as in the web page: 8 bits a pixel
    fit: bool = False  # whether the voxels are fitted, in place of the network alone
    prune: float = 0.0  # see Finishing

    @property
    def key(self) -> str:
        """A name that identifies the configuration: 10 hexadecimal digits of a hash of its JSON value."""
        return hashlib.sha256(json_bytes(self.to_json())).hexdigest()[:10]

    @property
    def baked(self) -> str:
        """The key of the bake alone: configurations with the same one share a bake."""
        return Configuration(bake=self.bake, field=self.field).key

    @property
    def finishing(self) -> Finishing:
        """What is done after the bake."""
        return Finishing(self.refine, self.fit, self.prune)

    def to_json(self) -> dict[str, Any]:
        """JSON values of all that changes a result; "fit" and "prune" only where they do, so that rows without them keep their keys."""
        march = {"tolerance": self.march.tolerance, "stop_transmittance": self.march.stop_transmittance}
        march |= {"per_sample_network": self.march.per_sample_network}
        rest = {"refine": self.refine, "codec": self.codec.to_json(), "field": self.field, "page": self.page}
        rest |= {name: value for name, value in (("fit", self.fit), ("prune", self.prune)) if value}
        return {"bake": self.bake.to_json(), "version": BAKE_VERSION, "march": march, **rest}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Configuration:
        """The configuration that `to_json` wrote. Raises KeyError or TypeError on other values."""
        return cls(
            BakeSettings.from_json(value["bake"]),
            value["refine"],
            CodecSettings.from_json(value["codec"]),
            MarchSettings(**value["march"]),
            value["field"],
            value["page"],
            value.get("fit", False),
            value.get("prune", 0.0),
        )


@dataclass(frozen=True)
class PlanStep:
    """A configuration that a study measures."""

    config: Configuration
    parameters: tuple[tuple[str, str], ...]  # (parameter, its value for people) of each path that the configuration is on

    @property
    def text(self) -> str:
        """Its parameters and their values in words."""
        return "; ".join(f"{parameter}: {value}" for parameter, value in self.parameters)


RESOLUTION, SAMPLES, CODEC, TOLERANCE = "resolution", "samples a voxel", "codec", "tolerance"
ALPHA, VISIBILITY, BITS, NETWORK, REFINE, TRAINING = "alpha threshold", "visibility threshold", "bits", "network", "refining", "training"
FITTING, PRUNING = "fitting", "pruning"
PRUNED = (0.005, 0.01, 0.02)  # shares of a pixel below which voxels are dropped
WATERFALL = "stages"
STAGES = ("grid", "culling", "quantising", "refining", "codec", "web page")


def plan_steps(
    baseline: Configuration,
    features: bool,
    cameras: bool,
    refinable: bool,
    codecs: Sequence[str],
    fields: Sequence[str] = (),
    images: bool = False,
) -> list[PlanStep]:
    """The configurations to measure, in order: coarse resolutions; the baseline; variants that reuse its bake; variations of one parameter
    that need a bake; other ways to store and march the coarse resolutions. Each configuration is listed once, with all its parameters.

    features: whether the field is view-dependent. cameras: whether it knows its training cameras. refinable: whether its training images
    are there to fine-tune it on. codecs: names that can be written here. fields: names of fields with other lengths of training.
    images: whether the training images are there, be it a diffuse field.
    """
    found: dict[str, PlanStep] = {}
    baseline = baseline if refinable else replace(baseline, refine=False)
    for config, parameter, value in _variations(baseline, features, cameras, refinable, codecs, fields, images or refinable):
        parameters = found[config.key].parameters if config.key in found else ()
        found[config.key] = PlanStep(config, parameters if (parameter, value) in parameters else (*parameters, (parameter, value)))
    return list(found.values())


def _variations(
    baseline: Configuration,
    features: bool,
    cameras: bool,
    refinable: bool,
    codecs: Sequence[str],
    fields: Sequence[str],
    images: bool,
) -> Iterator[tuple[Configuration, str, str]]:
    size = baseline.bake.resolution
    coarse = [with_bake(baseline, resolution=max(2, round(share * size))) for share in COARSE_SHARES]
    stored = [PNG, *_codecs(codecs)]
    for config in coarse:
        yield config, RESOLUTION, f"{config.bake.resolution} voxels"
    yield baseline, RESOLUTION, f"{size} voxels"
    yield from _variations_of_storage(baseline, stored)
    for tolerance in sorted({baseline.march.tolerance, 1e-3, 1e-2, 3e-2}):
        yield replace(baseline, march=replace(baseline.march, tolerance=tolerance)), TOLERANCE, f"{tolerance:g}"
    if features:
        yield baseline, NETWORK, "once a pixel"
        yield replace(baseline, march=replace(baseline.march, per_sample_network=True)), NETWORK, "at every sample"
    if refinable:
        yield baseline, REFINE, "refined"
        yield replace(baseline, refine=False), REFINE, "not refined"
    if images:
        yield from _finished(baseline, coarse)
    yield from _stages(baseline, cameras, refinable, stored)
    if features:
        yield replace(with_bake(baseline, network=False), refine=False), NETWORK, "none"
    yield from _variations_of_bake(baseline, cameras)
    for name in fields:
        yield replace(baseline, field=name), TRAINING, name
    for config in reversed(coarse):
        for codec in stored[1:]:
            yield replace(config, codec=codec), f"{RESOLUTION}, {codec.text}", f"{config.bake.resolution} voxels"
        marched = replace(config, march=replace(config.march, tolerance=1e-2))
        yield marched, f"{RESOLUTION}, tolerance 0.01", f"{config.bake.resolution} voxels"


def _finished(baseline: Configuration, coarse: Sequence[Configuration]) -> Iterator[tuple[Configuration, str, str]]:
    """Voxels dropped, voxels fitted, on coarser grids too, and both."""
    yield baseline, PRUNING, "none"
    for share in PRUNED:
        yield replace(baseline, prune=share), PRUNING, f"{share:g}"
    yield baseline, FITTING, "not fitted"
    yield replace(baseline, fit=True), FITTING, "fitted"
    for config in (*coarse[2:], baseline):
        yield replace(config, fit=True), f"{RESOLUTION}, fitted", f"{config.bake.resolution} voxels"
    for config in (*coarse[-1:], baseline):
        pruned = replace(config, fit=True, prune=PRUNED[1])
        yield pruned, f"{RESOLUTION}, fitted, pruned at {PRUNED[1]:g}", f"{config.bake.resolution} voxels"


def _variations_of_storage(baseline: Configuration, stored: Sequence[CodecSettings]) -> Iterator[tuple[Configuration, str, str]]:
    """The lossless codecs, then the lossy ones with each quality."""
    for codec in stored:
        if codec.lossless:
            yield replace(baseline, codec=codec), CODEC, codec.text
    for codec in stored:
        if not codec.lossless:
            yield baseline, quality_of(codec), "lossless"
            yield replace(baseline, codec=codec), quality_of(codec), str(codec.quality)


def _variations_of_bake(baseline: Configuration, cameras: bool) -> Iterator[tuple[Configuration, str, str]]:
    """Bits, samples a voxel and thresholds of a bake."""
    baked = baseline.bake
    yield baseline, BITS, "8"
    yield with_bake(baseline, quantise=False), BITS, "32"
    yield baseline, SAMPLES, "auto" if baked.supersampling == AUTO_SUPERSAMPLING else str(baked.supersampling)
    for count in sorted({1, 2, 4, 8} - {baked.supersampling}):
        yield with_bake(baseline, supersampling=count), SAMPLES, str(count)
    for alpha in sorted({baked.alpha_threshold, 0.001, 0.02, 0.1}):
        yield with_bake(baseline, alpha_threshold=alpha), ALPHA, f"{alpha:g}"
    if cameras:
        for threshold in sorted({baked.visibility_threshold, 0.001, 0.1}):
            yield with_bake(baseline, visibility_threshold=threshold), VISIBILITY, f"{threshold:g}"
        yield with_bake(baseline, visibility=False), VISIBILITY, "nothing culled"


def _stages(
    baseline: Configuration, cameras: bool, refinable: bool, stored: Sequence[CodecSettings]
) -> Iterator[tuple[Configuration, str, str]]:
    """The stages from the field to the web page, each with one loss more (see STAGES)."""
    plain = replace(baseline, refine=False)
    yield with_bake(plain, quantise=False, visibility=False), WATERFALL, STAGES[0]
    if cameras:
        yield with_bake(plain, quantise=False), WATERFALL, STAGES[1]
    yield plain, WATERFALL, STAGES[2]
    if refinable:
        yield baseline, WATERFALL, STAGES[3]
    lossy = next((codec for codec in stored if not codec.lossless and codec.name != "h264"), PNG)
    yield replace(baseline, codec=lossy), WATERFALL, STAGES[4]
    shown = replace(baseline.march, stop_transmittance=PAGE_STOP)
    yield replace(baseline, codec=lossy, march=shown, page=True), WATERFALL, STAGES[5]


def _codecs(names: Sequence[str]) -> Iterator[CodecSettings]:
    for name in names:
        if CodecSettings(name).lossless:
            yield CodecSettings(name)
            yield CodecSettings(name, half_features=True)
        else:
            yield from (CodecSettings(name, quality) for quality in (90, 70, 50))


def with_bake(config: Configuration, **changes: Any) -> Configuration:
    """The configuration with other settings of the bake."""
    return replace(config, bake=replace(config.bake, **changes))


def quality_of(codec: CodecSettings) -> str:
    """The name of the parameter that is a lossy codec's quality."""
    return f"{codec.name.upper()} quality"


def available(names: Sequence[str]) -> list[str]:
    """The codecs of these names that can be written with the installed packages."""
    found = []
    for name in names:
        try:
            CodecSettings(name).check()
        except SnergError:
            continue
        found.append(name)
    return found
