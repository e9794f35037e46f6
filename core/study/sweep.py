"""The measurements of a study: each configuration is baked, stored, read back, rendered and timed (JAX where a field is baked).

A row is written as soon as it is measured, and is not measured again when a study is continued.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..artifact import open_field
from ..baking.bake_field import bake_field
from ..baking.finish import FINISHING_STAGES, finish
from ..data.dataset import Dataset
from ..errors import SnergError
from ..export.codecs import PNG
from ..export.scene_files import read_scene, write_scene
from ..export.scene_json import MAX_WEIGHT
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..io.files import folder_bytes, write_arrays, write_bytes
from ..io.guard import read_arrays, reading
from ..io.images import over, to_uint8, write_png
from ..io.json_files import json_bytes, read_json
from ..io.schema import number, numbers, record, text
from ..nerf.field import Field
from ..nerf.frame import Frame
from ..nerf.model import SHAPES, ViewNetwork
from ..nerf.render import render_field
from ..progress import Progress, silent, within
from ..rendering.acceleration import acceleration_of
from ..rendering.render import render_scene
from ..scene.scene import Scene
from .cost_model import Estimate, estimate
from .evaluate import Score
from .field_probe import FieldProbe, probe_field
from .lpips import lpips
from .machine import watched
from .metrics import IDENTICAL
from .pareto import StudyRow
from .plan import Configuration, PlanStep

FIELD = "field"  # key of the row of a field itself
SMALL = 4  # ratio of the sides of a view and of the smaller picture whose time predicts the view's
WRITING_SECONDS = 4.0  # to store a scene and read it back, about: of Lego at 512 voxels
NETWORK_SLOWDOWN = 12.0  # of a frame whose network runs at every sample in place of once a pixel, about: of scenes with features


@dataclass(frozen=True, eq=False)
class StudySubject:
    """What a study measures."""

    fields: dict[str, Path]  # folders of fields by name, '' where there is one
    scene: Scene | None  # a baked scene, where there is no field
    views: Dataset  # held-out views to measure on
    training: Dataset | None  # images to fine-tune on, None where they are missing
    box: Box | None  # of the bakes, None for the field's whole domain
    background: tuple[float, float, float]  # RGB in [0, 1] that images are composited over
    repeats: int = 1  # of each timing; the median counts


class Sweep:
    """The rows of a study in a folder: rows/KEY.json, pictures/KEY.png, and work/ with bakes that several rows share."""

    def __init__(self, subject: StudySubject, out: Path, stored: str = "stored") -> None:
        """Read the rows that the folder has. stored: the folder in work/ of the scene that is stored and read back, which no other
        process may use. Raises SnergError when the rows cannot be read."""
        self.subject, self.out = subject, out
        self._stored_at = out / "work" / stored
        self.rows = {path.stem: read_row(path) for path in sorted((out / "rows").glob("*.json"))}
        self._fields: dict[str, Field] = {}
        self._probes: dict[str, FieldProbe] = {}
        self._held: tuple[str, Scene, dict[str, Any]] | None = None
        self._stored: dict[tuple[str, str, str], tuple[Scene, dict[str, float]]] = {}

    # Inputs

    @cached_property
    def truth(self) -> list[NDArray[Any]]:
        """The held-out images [H, W, 3] in [0, 1], composited over the background."""
        return [over(self.subject.views.read(index), self.subject.background) for index in range(len(self.subject.views.views))]

    def field(self, name: str) -> Field:
        """A field by its name, read once."""
        if name not in self._fields:
            self._fields[name] = open_field(self.subject.fields[name])
        return self._fields[name]

    def probe(self, name: str) -> FieldProbe:
        """The field probe of a field, for predictions; measured once."""
        if name not in self._probes:
            self._probes[name] = probe_field(self.field(name))
        return self._probes[name]

    def refinable(self, name: str) -> bool:
        """Whether a bake of a field can be fine-tuned: the field is view-dependent, and its training images are there."""
        return self.subject.training is not None and self.field(name).network is not None

    def predicted(self, config: Configuration) -> Estimate | None:
        """The estimate of a configuration on this machine; None for a scene that was baked before."""
        if self.subject.scene is not None:
            return None
        camera = self.subject.views.cameras[0]
        probe = self.probe(config.field)
        return estimate(probe, self._box(probe.field), config.bake, config.finishing, (camera.width, camera.height), codec=config.codec)

    def _box(self, field: Field) -> Box:
        return self.subject.box if self.subject.box is not None else field.domain.world_box()

    def needs(self, config: Configuration) -> float:
        """Predicted seconds to measure a configuration; a bake that is kept is not counted."""
        count, estimated = len(self.subject.views.views) * self.subject.repeats, self.predicted(config)
        if estimated is None:
            known = [row["ms"] / 1e3 for row in self.rows.values() if "ms" in row]
            return WRITING_SECONDS + count * (statistics.median(known) if known else 1.0)
        slowdown = NETWORK_SLOWDOWN if config.march.per_sample_network else 1.0
        seconds = count * (slowdown * estimated.preview + 0.1) + WRITING_SECONDS
        if not self._baked_already(config):
            seconds += estimated.bake + estimated.tables
        if not self._finished_at(config).exists():
            seconds += estimated.finishing
        return seconds

    # One row

    def row(self, step: PlanStep, progress: Progress = silent) -> StudyRow:
        """Measure a configuration, and write its row and its picture. Raises Cancelled when `progress` does; then nothing is written."""
        config = step.config
        estimated = self.predicted(config)
        scene, report = self.scene_of(config, within(progress, 0, 0.5))
        shown, stored = self._stored_scene(config, scene)
        row: StudyRow = {"key": config.key, "config": config.to_json(), **report, **stored}
        row["seconds"] = report["seconds"] | {name: value for name, value in stored.items() if name in ("write", "read")}
        began = time.perf_counter()
        acceleration_of(shown)
        row["seconds"]["tables"] = round(time.perf_counter() - began, 3)
        row |= self._measured(config.key, lambda camera: render_scene(shown, camera, config.march), config.page, within(progress, 0.6, 1))
        row |= {"blocks": len(shown.cells), "memory_megabytes": round(shown.cells.nbytes / 1e6, 1), "voxels": list(shown.shape)}
        if estimated is not None:
            row["predicted"] = self._prediction(estimated, config)
        return self._keep(row)

    def field_row(self, name: str, progress: Progress = silent) -> StudyRow:
        """Measure a field itself (JAX)."""
        field = self.field(name)
        key = field_key(name)
        row: StudyRow = {"key": key, "config": None, "field": name, "trained_seconds": field.about.get("seconds")}
        row |= self._measured(key, lambda camera: render_field(field, camera), False, progress)
        return self._keep(row | {"megabytes": round(folder_bytes(self.subject.fields[name]) / 1e6, 3)})

    def field_seconds(self, name: str) -> float:
        """Predicted seconds to measure a field itself, from the time of a small picture of it (JAX)."""
        camera, field = self.subject.views.cameras[0], self.field(name)
        small = camera.resized(*(max(8, side // SMALL) for side in (camera.width, camera.height)))
        render_field(field, small)
        began = time.perf_counter()
        render_field(field, small)
        return (time.perf_counter() - began) * SMALL**2 * len(self.subject.views.views) * self.subject.repeats

    def _keep(self, row: StudyRow) -> StudyRow:
        (self.out / "rows").mkdir(exist_ok=True)
        write_bytes(self.out / "rows" / f"{row['key']}.json", json_bytes(row))
        self.rows[row["key"]] = row
        return row

    def _measured(self, key: str, render: Any, page: bool, progress: Progress) -> StudyRow:
        """Quality on the views, and milliseconds a frame: the median and the 95th percentile over the views of medians over repeats."""
        views, score = self.subject.views, Score()
        perceived: list[float] = []  # LPIPS of each view, where it is installed
        render(views.cameras[0].resized(32, 32))  # compiling, and what is computed once for a scene, is not part of a frame
        count, middle = len(views.views), len(views.views) // 2
        for index, (camera, truth) in enumerate(zip(views.cameras, self.truth, strict=True)):
            frame, seconds = self._repeated(render, camera)
            picture = frame.over(self.subject.background)
            picture = to_uint8(picture).astype(np.float32) / 255 if page else picture
            score.add(picture, truth, seconds, views.mask(index), camera.name)
            if (difference := lpips(picture, truth, views.mask(index))) is not None:
                perceived.append(difference)
            if index == middle:
                self._show(key, picture, truth)
            progress((index + 1) / count, f"View {index + 1} of {count}: {score.text()}")
        result = score.result()
        ms = [1e3 * seconds for seconds in score.seconds]
        timed = {"ms": round(statistics.median(ms), 3), "ms_95": round(float(np.percentile(ms, 95)), 3)}
        decibels = {name: IDENTICAL if result[name] is None else result[name] for name in ("psnr", "psnr_pooled")}
        each = [IDENTICAL if view["psnr"] is None else view["psnr"] for view in score.views()]
        looks = {"flip": result.get("flip"), "lpips": round(float(np.mean(perceived)), 5) if perceived else None}
        return {**decibels, "ssim": result["ssim"], **looks, "psnr_of_views": each, "views": count, **timed}

    def _show(self, key: str, picture: NDArray[Any], truth: NDArray[Any]) -> None:
        """Write a row's picture [H, W, 3], and once the true image [H, W, 3]."""
        folder = self.out / "pictures"
        folder.mkdir(exist_ok=True)
        write_png(folder / f"{key}.png", to_uint8(picture))
        if not (folder / "truth.png").is_file():
            write_png(folder / "truth.png", to_uint8(truth))

    def _repeated(self, render: Any, camera: Camera) -> tuple[Frame, float]:
        seconds = []
        for _ in range(self.subject.repeats):
            began = time.perf_counter()
            frame: Frame = render(camera)
            seconds.append(time.perf_counter() - began)
        return frame, statistics.median(seconds)

    def _prediction(self, estimated: Estimate, config: Configuration) -> dict[str, float]:
        """The estimate by names of the row, without compiling, which the field probe did, and without memory, which this process shares."""
        result = {
            "bake": estimated.bake - estimated.seconds.get("start", 0.0),
            "ms": 1e3 * estimated.preview,
            "megabytes": estimated.megabytes,
        }
        result |= {name: estimated.seconds[name] for name in FINISHING_STAGES if name in estimated.seconds}
        return {name: round(value, 3) for name, value in result.items()}

    # Scenes

    def scene_of(self, config: Configuration, progress: Progress = silent) -> tuple[Scene, dict[str, Any]]:
        """The scene of a configuration before it is stored, and {"seconds": of its stages, "peak_megabytes", "samples"}."""
        scene, report = self._baked(config, within(progress, 0, 0.7))
        stages = config.finishing.stages(scene.network is not None)
        if not stages or self.subject.scene is not None or self.subject.training is None:
            return scene, report
        shown = within(progress, 0.7, 1)
        scene, seconds = self._refined(config, scene, shown) if stages == ("refine",) else self._finished(config, scene, shown)
        return scene, report | {"seconds": report["seconds"] | {name: round(took, 3) for name, took in seconds.items()}}

    def _refined(self, config: Configuration, scene: Scene, progress: Progress) -> tuple[Scene, dict[str, float]]:
        """The scene with its network fine-tuned now or in an earlier run, and the seconds. The network alone is kept."""
        path = self._finished_at(config)
        if not path.is_file():
            assert self.subject.training is not None
            better, seconds = finish(scene, self.subject.training, config.finishing, self.subject.background, progress)
            assert better.network is not None
            write_arrays(path, {**better.network._asdict(), "seconds": np.array(seconds["refine"])})
        network, took = _read_refined(path)
        return replace(scene, network=network), {"refine": took}

    def _finished(self, config: Configuration, scene: Scene, progress: Progress) -> tuple[Scene, dict[str, float]]:
        """The scene with its voxels pruned or fitted now or in an earlier run, and the seconds of each stage."""
        folder = self._finished_at(config)
        if not folder.exists():
            assert self.subject.training is not None
            better, seconds = finish(scene, self.subject.training, config.finishing, self.subject.background, progress)
            write_scene(replace(better, about={**better.about, "finishing_seconds": seconds}), folder)
        kept = read_scene(folder)
        return kept, dict(kept.about["finishing_seconds"])

    def _finished_at(self, config: Configuration) -> Path:
        """Where a configuration's fine-tuned network is kept, or the whole scene where its voxels change."""
        if config.finishing.stages(True) in ((), ("refine",)):
            return self._work(config) / "refined.npz"
        chosen = (f"pruned-{config.prune:g}",) if config.prune else ()
        return self._work(config) / "-".join((*chosen, *(("fitted",) if config.fit else ("refined",) if config.refine else ())))

    def _baked(self, config: Configuration, progress: Progress) -> tuple[Scene, dict[str, Any]]:
        """The scene of the bake, from memory, from an earlier run, or baked now, and its report."""
        if self.subject.scene is not None:
            return self.subject.scene, {"seconds": {}}
        if self._held is not None and self._held[0] == config.baked:
            return self._held[1:]
        folder = self._work(config)
        if not self._baked_already(config):
            self._bake(config, folder, progress)
        self._held, self._stored = (config.baked, read_scene(folder / "scene"), read_json(folder / "baked.json")), {}
        return self._held[1:]

    def _bake(self, config: Configuration, folder: Path, progress: Progress) -> None:
        field = self.probe(config.field).field  # the probe compiles what the first bake would
        stages: list[dict[str, float]] = []
        with watched() as peak:
            for turn in range(self.subject.repeats):
                part = within(progress, turn / self.subject.repeats, (turn + 1) / self.subject.repeats)
                snerg, _ = bake_field(field, self._box(field), config.bake, None, part)
                stages.append(snerg.about["bake"]["seconds"])
        seconds = {name: round(statistics.median(lap[name] for lap in stages), 3) for name in stages[0]}
        report = {"seconds": {"bake": round(sum(seconds.values()), 3), **seconds}, "samples": snerg.about["bake"]["samples"]}
        report["peak_megabytes"] = None if peak.most is None else round(peak.most / 1e6)
        report["kept_voxels"] = snerg.about["bake"]["voxels"]
        folder.mkdir(parents=True, exist_ok=True)
        write_scene(snerg, folder / "scene")
        write_bytes(folder / "baked.json", json_bytes(report))

    def _stored_scene(self, config: Configuration, snerg: Scene) -> tuple[Scene, dict[str, float]]:
        """The scene as it is read from its files, and {"megabytes", "write" and "read" in seconds}."""
        key = (config.baked, str(config.finishing), str(config.codec.to_json()))
        if key in self._stored:
            return self._stored[key]
        folder = self._stored_at
        began = time.perf_counter()
        write_scene(snerg, folder, codec=config.codec if snerg.quantised else PNG)
        written = time.perf_counter()
        shown = read_scene(folder)
        report = {"write": round(written - began, 3), "read": round(time.perf_counter() - written, 3)}
        report["megabytes"] = round(folder_bytes(folder) / 1e6, 3)
        self._stored = {key: (shown, report)}  # the last one alone, because they are large
        return shown, report

    def _work(self, config: Configuration) -> Path:
        return self.out / "work" / config.baked

    def _baked_already(self, config: Configuration) -> bool:
        return (self._work(config) / "baked.json").is_file()


def field_key(name: str) -> str:
    """The key of the row of a field itself."""
    return FIELD + (f"-{name.replace(' ', '-')}" if name else "")


def _read_refined(path: Path) -> tuple[ViewNetwork, float]:
    """A fine-tuned network and the seconds that it took, from an earlier run. Raises SnergError where the file is damaged."""
    with reading(path, "delete it to have it made again"):
        kept = read_arrays(path, 2**20)
        arrays = [numbers(kept[name], name, shape, MAX_WEIGHT) for name, shape in zip(ViewNetwork._fields, SHAPES, strict=True)]
        return ViewNetwork(*(array.astype(np.float32) for array in arrays)), float(kept["seconds"])


def read_row(path: Path) -> StudyRow:
    """A row of an earlier run. Raises SnergError when the file is not one."""
    row = read_json(path)
    if not (isinstance(row, dict) and {"key", "config", "psnr", "ms", "megabytes"} <= row.keys() and row["key"] == path.stem):
        raise SnergError(f"{path} is not a row of a study; delete it to have it measured again.")
    with reading(path, "delete it to have it measured again"):
        try:
            return _checked_row(row)
        except SnergError as error:  # of settings that cannot be used, which do not know the file
            raise ValueError(str(error)) from error


def _checked_row(row: StudyRow) -> StudyRow:
    """The row. Raises ValueError, KeyError or TypeError on a row without what the report needs."""
    for name in ("psnr", "ms", "megabytes"):
        number(row[name], name)
    for name in ("ssim", "flip", "lpips", "trained_seconds", "peak_megabytes"):
        if row.get(name) is not None:
            number(row[name], name)
    for name in ("seconds", "predicted"):
        for part, value in record(row.get(name, {}), name).items():
            number(value, part)
    if not isinstance(row.get("psnr_of_views", []), list):
        raise ValueError("psnr_of_views is not a list")
    for value in row.get("psnr_of_views", []):
        number(value, "psnr_of_views")
    if row["config"] is not None:
        config = record(row["config"], "config")
        if not isinstance(config["refine"], bool) or not isinstance(config["page"], bool):
            raise ValueError("refine or page is not a boolean")
        text(config["field"], "field")
        Configuration.from_json(config)
    return _with_mean_psnr(row)


def _with_mean_psnr(row: StudyRow) -> StudyRow:
    """The row, with the mean of its views' decibels as `psnr`: rows of versions without `psnr_pooled` have the pooled value there."""
    if "psnr_pooled" in row:
        number(row["psnr_pooled"], "psnr_pooled")
        return row
    each = row.get("psnr_of_views") or [row["psnr"]]
    return row | {"psnr": round(statistics.fmean(each), 4), "psnr_pooled": row["psnr"]}
