"""`make bench-grid`: measures baking, storing and rendering a scene, and prints tables with the machine they were measured on.

FIELD=FOLDER names a trained field, whose dataset is measured against (or DATA=FOLDER); without it one is trained on the demo's
scene. ROWS=NAME,NAME chooses from PARTS and ABLATIONS below; `large` takes minutes and gigabytes. Bakes run as `snerg bake` in
processes of their own, so that the peak memory is theirs alone. Writes to build/bench/grid: grid.json, scaling.png, the scenes,
and of the baked scene pictures beside the truth.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import march as marching
from common import OUT, demo, described, markdown, on_machine, snerg
from plot import Panel, save_plot

from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.data.dataset import Dataset
from snerg.core.errors import SnergError
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.io.files import folder_bytes
from snerg.core.io.images import over, write_png
from snerg.core.io.json_files import json_bytes
from snerg.core.nerf.checkpoint import read_field
from snerg.core.progress import silent
from snerg.core.rendering.render import MarchSettings
from snerg.core.scene.scene import Scene
from snerg.core.study.contact_sheet import contact_sheet, error_picture
from snerg.core.study.evaluate import COLUMNS, EvaluationTarget, Score, held_out, open_target
from snerg.core.training.provenance import options_of, trained
from snerg.core.training.validation import some_views

DEFAULT_MARCH = MarchSettings()
MINUTES = 3.0  # to train the demo's field


@dataclass(frozen=True)
class Ablation:
    """A row of the paper's tables of ablations."""

    about: str  # the description in the table
    bake: tuple[str, ...] = ()  # further options of `snerg bake`; none: the scene of the whole method is used
    scale: float = 1.0  # factor of the resolution
    codec: CodecSettings | None = None  # how the scene is stored, if not as PNG
    march: MarchSettings = DEFAULT_MARCH  # how it is rendered


ABLATIONS = {
    "whole": Ablation("the whole method, PNG"),
    "no-refine": Ablation("not refined", ("--no-refine",)),
    "fit": Ablation("voxels fitted", ("--fit",)),
    "prune": Ablation("voxels dropped below 0.01", ("--prune", "0.01")),
    "fit-prune": Ablation("both", ("--fit", "--prune", "0.01")),
    "no-visibility": Ablation("what no camera sees is kept", ("--no-visibility",)),
    "no-network": Ablation("no view dependence", ("--no-network",)),
    "float": Ablation("not quantised", ("--float",)),
    "sample-network": Ablation("network at every sample", march=MarchSettings(per_sample_network=True)),
    "webp": Ablation("WebP, lossless", codec=CodecSettings("webp")),
    "jxl": Ablation("JPEG XL, lossless", codec=CodecSettings("jxl")),
    "jpeg": Ablation("JPEG, quality 90", codec=CodecSettings("jpeg", 90)),
    "avif": Ablation("AVIF, quality 90", codec=CodecSettings("avif", 90)),
    "h264": Ablation("H.264, quality 70", codec=CodecSettings("h264", 70)),
    "three-quarters": Ablation("{} voxels", scale=0.75),
    "half": Ablation("{} voxels", scale=0.5),
    "quarter": Ablation("{} voxels", scale=0.25),
    "three-quarters-fit": Ablation("{} voxels, fitted", ("--fit",), 0.75),
    "half-fit": Ablation("{} voxels, fitted", ("--fit",), 0.5),
}


@dataclass(frozen=True, eq=False)
class Setup:
    """What is measured. views: some of the held-out ones, of how many; size: pixels along the longer side of the smaller preview."""

    field: Path
    out: Path
    views: Dataset
    of: int
    resolution: int
    large: int
    size: int
    background: tuple[float, float, float]

    def baked(self, name: str, *arguments: str, resolution: int | None = None) -> dict[str, Any]:
        """Bake a scene in a process of its own; returns its times, sizes and peak memory, and stores them beside the scene."""
        folder, began = self.out / "scenes" / name, time.perf_counter()
        size = ("--resolution", str(resolution or self.resolution))
        result, peak = snerg("bake", str(self.field), "--out", str(folder), *size, *arguments)
        wall = round(time.perf_counter() - began, 2)
        facts = {"seconds": result["seconds"], "wall": wall, "peak_gb": peak, "stages": result["about"]["bake"]["seconds"]}
        facts |= {"resolution": resolution or self.resolution, "blocks": result["blocks"], "samples": result["about"]["bake"]["samples"]}
        facts |= {"atlas_gb": result["memory_megabytes"] / 1e3, "megabytes": result["megabytes"]}
        (folder.parent / f"{name}.json").write_bytes(json_bytes({"field": self.stamp, "arguments": arguments, **facts}))
        return facts

    def whole(self) -> dict[str, Any]:
        """The measurements of the bake without ablation, which other rows reuse; baked once for a field and a resolution."""
        path = self.out / "scenes" / "whole.json"
        facts = json.loads(path.read_text()) if path.is_file() else {}
        if (facts.get("field"), facts.get("resolution")) != (self.stamp, self.resolution):
            facts = self.baked("whole")
        return facts

    @cached_property
    def scene(self) -> Scene:
        """The scene baked without ablation."""
        self.whole()
        return read_scene(self.out / "scenes" / "whole")

    @property
    def stamp(self) -> str:
        """Identifies the field: its path and the time of its last change."""
        return f"{self.field.resolve()} {(self.field / 'field.npz').stat().st_mtime_ns}"


def measure(setup: Setup, path: Path, settings: MarchSettings = DEFAULT_MARCH, pictures: Path | None = None) -> dict[str, Any]:
    """{"psnr" (mean of views), "ssim", "frame"} of a field or a scene on the views; frame: median seconds.

    pictures: file for a contact sheet, if any.
    """
    subject: EvaluationTarget = open_target(path, settings)
    score, rows = Score(), []
    for index, camera in enumerate(setup.views.cameras):
        if not index:
            subject.render(camera, silent)  # warm-up
        began = time.perf_counter()
        frame = subject.render(camera, silent)
        seconds = time.perf_counter() - began
        picture, truth = frame.over(setup.background), over(setup.views.read(index), setup.background)
        score.add(picture, truth, seconds, setup.views.mask(index), camera.name)
        rows.append((f"{camera.name}  {score.last()}", [truth, picture, error_picture(truth, picture)]))
    if pictures is not None:
        write_png(pictures, contact_sheet(rows[:6], COLUMNS, 480))
    result = score.result()
    return {"psnr": result["psnr"], "ssim": result["ssim"], "frame": statistics.median(score.seconds)}


def bake_part(setup: Setup) -> dict[str, Any]:
    """Bake with and without fine-tuning: times, and the quality after each step."""
    unrefined = setup.baked("no-refine", "--no-refine")
    refined = setup.baked("whole")
    scenes = setup.out / "scenes"
    return {
        "unrefined": unrefined,
        "refined": refined,
        "quality": {
            "field": measure(setup, setup.field),
            "bake": measure(setup, scenes / "no-refine"),
            "refined": measure(setup, scenes / "whole", pictures=setup.out / "contact.png"),
        },
    }


def large_part(setup: Setup) -> dict[str, Any]:
    """A bake at the paper's largest resolution."""
    facts = setup.baked("large", "--no-refine", resolution=setup.large)
    shutil.rmtree(setup.out / "scenes" / "large")
    return facts


def scaling_part(setup: Setup) -> dict[str, Any]:
    """How the times grow with rays, samples and blocks, with a plot."""
    rays, samples = marching.growing(setup.scene, setup.views.cameras[0], setup.size)
    source, blocks = read_field(setup.field), []
    for turn, share in enumerate((0.2, 0.2, 0.3, 0.4, 0.5, 0.6)):  # the first bake compiles and is not counted
        settings = BakeSettings(max(2, round(share * setup.resolution)), supersampling=1)
        began = time.perf_counter()
        baked = bake(source, source.domain.world_box(), source.cameras, settings)
        if turn:
            blocks.append((float(len(baked.cells)), time.perf_counter() - began))
    panels = [
        Panel("March: time against rays", "rays", rays),
        Panel("March: time against samples", "samples taken", samples),
        Panel("Bake: time against blocks", "blocks baked", blocks),
    ]
    save_plot(setup.out / "scaling.png", panels)
    return {panel.x: {"points": panel.points, "r_squared": panel.line()[2]} for panel in panels}


def ablated(setup: Setup, row: Ablation, name: str) -> dict[str, Any]:
    """Measure an ablation."""
    folder, resolution = setup.out / "scenes" / name, round(row.scale * setup.resolution)
    if row.bake or row.scale != 1:
        facts = setup.baked(name, *row.bake, resolution=resolution)
    else:
        facts, began = setup.whole(), time.perf_counter()
        if row.codec is not None:
            write_scene(setup.scene, folder, codec=row.codec)
            facts = facts | {"write": round(time.perf_counter() - began, 2)}
        else:
            folder = setup.out / "scenes" / "whole"
    kept = {key: facts[key] for key in ("seconds", "peak_gb", "blocks", "atlas_gb", "write") if key in facts}
    return {"about": row.about.format(resolution), **kept, "megabytes": folder_bytes(folder) / 1e6, **measure(setup, folder, row.march)}


PARTS: dict[str, Callable[[Setup], dict[str, Any]]] = {
    "bake": bake_part,
    "large": large_part,
    "preview": lambda setup: marching.preview(setup.scene, setup.views.cameras[:6], setup.size),
    "profile": lambda setup: marching.profile(setup.scene, setup.views.cameras[:6], setup.size),
    "gather": lambda setup: marching.gathering(setup.scene, setup.views.cameras[0], setup.size),
    "scaling": scaling_part,
}


def main(arguments: list[str] | None = None) -> int:
    """Measure the chosen rows in order; returns the exit code, 0 on success."""
    options = parsed(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    machine, results = described(), {}
    try:
        setup = prepared(options)
        for name in options.rows:
            print(f"{name} ...", file=sys.stderr, flush=True)
            part = PARTS.get(name)
            results[name] = part(setup) if part is not None else ablated(setup, ABLATIONS[name], name)
            (options.out / "grid.json").write_text(json.dumps({"machine": machine, "rows": results}, indent=1) + "\n")
    except SnergError as error:
        print(f"bench-grid: {error}", file=sys.stderr)
        return 2
    print("\n\n".join([on_machine(machine), subject(setup), *tables(results, setup)]))
    print(f"\nEverything is in {options.out}.")
    return 0


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The command-line options; those after --out are for tests of the benchmark itself."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [*PARTS, *ABLATIONS]
    parser.add_argument("--field", type=Path, help="a trained field (default: one of the demo's scene)")
    parser.add_argument("--data", type=Path, help="the dataset to measure on (default: what the field was trained on)")
    parser.add_argument("--rows", default="", help=f"of {', '.join(names)}, with commas (default: all)")
    parser.add_argument("--views", type=int, default=20, help="how many held-out views are measured, spread over all (default: 20)")
    parser.add_argument("--out", type=Path, default=OUT / "grid")
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--large", type=int, default=1000, help="the resolution of the row 'large'")
    parser.add_argument("--size", type=int, default=400, help="pixels along the longer side of the smaller preview")
    options = parser.parse_args(arguments)
    options.rows = [name for name in options.rows.split(",") if name] or names
    if unknown := [name for name in options.rows if name not in names]:
        parser.error(f"there is no row {unknown[0]!r}; choose from {', '.join(names)}")
    return options


def prepared(options: argparse.Namespace) -> Setup:
    """Open the field and the held-out views."""
    path = options.field or demo_field(OUT)
    source = read_field(path)
    known = trained(source.about)
    views = held_out(options.data or Path(source.dataset), options_of(known))
    some, background = some_views(views, options.views), open_target(path).background
    return Setup(path, options.out, some, len(views.views), options.resolution, options.large, options.size, background)


def demo_field(out: Path) -> Path:
    """A field of the demo's scene, trained on first use."""
    path = out / "demo" / "field"
    if not (path / "field.npz").is_file():
        snerg("train", str(demo(out)), "--out", str(path), "--minutes", f"{MINUTES:g}")
    return path


def subject(setup: Setup) -> str:
    """A sentence that says what was measured."""
    return f"{setup.views.root.name}, {len(setup.views.views)} of {setup.of} held-out views."


def tables(results: dict[str, Any], setup: Setup) -> list[str]:
    """A Markdown table for each part that was measured."""
    found = [figures(results)] if results.keys() & {"bake", "large", "preview"} else []
    if "profile" in results:
        found.append(profile_table(results["profile"]))
    if "gather" in results:
        found.append(gather_table(results["gather"]))
    if "scaling" in results:
        rows = [[name, f"{len(fit['points'])}", f"{fit['r_squared']:.4f}"] for name, fit in results["scaling"].items()]
        found.append(markdown("time against, points, R² of a straight line", rows) + f"\n\nThe plot: {setup.out / 'scaling.png'}")
    if rows := [[name, row] for name, row in results.items() if name in ABLATIONS]:
        found.append(ablation_table(rows))
    return found


def figures(results: dict[str, Any]) -> str:
    """The table of bake, memory, storage and preview."""
    rows: list[list[Any]] = []
    if bakes := results.get("bake"):
        one, two, quality = bakes["unrefined"], bakes["refined"], bakes["quality"]
        rows.append([f"bake, {one['resolution']} voxels", stages(one), memory(one)])
        rows.append(["refine", f"{two['seconds'].get('refine', 0):.1f} s", memory(two)])
        loss = [f"{step} {quality[step]['psnr']:.2f} dB" for step in ("field", "bake", "refined")]
        rows.append(["field to refined bake", f"{quality['refined']['psnr'] - quality['field']['psnr']:+.2f} dB", ", ".join(loss)])
        rows.append(["stored as PNG", f"{two['megabytes']:.1f} MB", f"{two['blocks']} blocks, {two['samples']} samples a voxel"])
    if large := results.get("large"):
        rows.append([f"bake, {large['resolution']} voxels", stages(large), memory(large)])
        writing = large["wall"] - large["seconds"]["bake"]
        rows.append(["the same stored as PNG", f"{large['megabytes']:.0f} MB", f"{writing:.0f} s to start and to write"])
    if shown := results.get("preview"):
        for one in (shown["small"], shown["large"]):
            name = f"preview, {one['pixels']} pixels a side"
            more = f"slowest view {one['slowest']:.3f} s, first picture {one['first']:.3f} s, "
            more += f"{one['shown']:.3f} s to half a level of 8 bits, as Blender shows it"
            rows.append([name, f"{one['seconds']:.3f} s", more])
        naive = shown["naive"]
        text = f"{naive['seconds']:.1f} s and {naive['ours']:.3f} s; largest difference {naive['difference']:.1e}"
        rows.append(["preview against a march without skipping", f"{naive['times']:.0f} x", text])
    return markdown("what, measured, more", rows)


def stages(facts: dict[str, Any]) -> str:
    """The seconds of a bake and of its stages, as text."""
    return f"{facts['seconds']['bake']:.1f} s ({', '.join(f'{name} {seconds:.1f}' for name, seconds in facts['stages'].items())})"


def memory(facts: dict[str, Any]) -> str:
    """The peak memory of a bake and the size of its atlas, as text."""
    peak = "unknown" if facts["peak_gb"] is None else f"{facts['peak_gb']:.2f} GB"
    return f"peak memory {peak}, of which the atlas {facts['atlas_gb']:.2f} GB"


def profile_table(found: dict[str, Any]) -> str:
    """The profile of the march; functions below 1 % are summed."""
    total = found["seconds_watched"]
    named = [row for row in found["rows"] if row["seconds"] >= 0.01 * total]
    other = total - sum(row["seconds"] for row in named)
    rows = [[f"`{row['function']}`", f"{row['seconds'] / total:.0%}", row["what"]] for row in named]
    head = f"{found['views']} views of {found['pixels']} pixels a side in one thread: {found['seconds'] / found['views']:.3f} s each"
    head += f" ({total / found['views']:.3f} s watched)."
    return f"{head}\n\n{markdown('function, share, what', [*rows, ['all others', f'{other / total:.0%}', '']])}"


def gather_table(found: dict[str, Any]) -> str:
    """The table of the march against memory bandwidth."""
    words = 8 * found["samples"]
    rows = [
        [name, f"{1000 * seconds:.0f} ms", f"{words / seconds / 1e6:.0f}", f"{found['march'] / seconds:.1f} x"]
        for name, seconds in (
            ("the whole march", found["march"]),
            ("reading its voxels, in its order", found["in_order"]),
            ("reading as many in no order", found["at_random"]),
        )
    ]
    read = f"{words / 1e6:.1f} million words of {found['word_bytes']} bytes"
    head = f"In one thread {found['rays']} rays take {found['samples']} samples: {read}."
    return f"{head}\n\n{markdown('what, time, million words a second, the march takes', rows)}"


def ablation_table(rows: list[list[Any]]) -> str:
    """The table of ablations, in the layout of the paper's tables 1 to 3 and 5."""
    cells = []
    for name, row in rows:
        spent = "—" if "write" in row else f"{sum(row['seconds'].values()):.0f} s"
        psnr = "identical" if row["psnr"] is None else f"{row['psnr']:.2f} dB"
        sizes = [f"{1000 * row['frame']:.0f} ms", f"{row['megabytes']:.1f} MB", f"{row['atlas_gb']:.2f} GB"]
        cells.append([name, row["about"], psnr, f"{row['ssim']:.4f}", *sizes, spent])
    return markdown("row, what, PSNR (mean of views), SSIM, a frame, stored, in memory, bake", cells)


if __name__ == "__main__":
    sys.exit(main())
