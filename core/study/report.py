"""A study as one HTML file that opens offline: plots and crops are in it, and every claim names the row that it comes from."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..io.files import write_bytes
from ..io.images import png_bytes, read_image
from .machine import machine_line
from .paper_tables import WHY, cell, tables
from .pareto import Row, front
from .plan import Step
from .plots import ablations, error_against_time, files, needs_matplotlib, predicted_and_measured, rate_and_distortion, waterfall
from .summary import PREDICTED, Point, accuracy, difference, knobs, making, predictions, stages

CROP, ZOOM = 96, 3  # pixels of a picture's crop, and how many times larger it is shown
COLUMN = {"ms": "ms a frame", "memory_gb": "GB in memory", "psnr": "PSNR", "ssim": "SSIM", "megabytes": "MB", "fps": "FPS"}
LIKE = 1.2  # times a frame up to which two of them take as long
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2937; max-width: 1080px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #d1d5db; }
table { border-collapse: collapse; font-size: 13px; } th, td { padding: 3px 9px; text-align: right; border-bottom: 1px solid #e5e7eb; }
th { text-align: left; background: #f9fafb; } td:first-child, td:nth-child(2) { text-align: left; }
figure { margin: 1rem 0; } figure img { max-width: 100%; } figcaption { color: #6b7280; font-size: 13px; }
code { background: #f3f4f6; padding: 0 4px; border-radius: 3px; font-size: 12px; } .wide { overflow-x: auto; }
.crops { display: flex; flex-wrap: wrap; gap: 10px; } .crops figure { margin: 0; }
.crops img { image-rendering: pixelated; display: block; }
tr.usual td { font-weight: 600; } tr.front td:first-child::after { content: " ●"; color: #0f766e; }
"""


@dataclass(frozen=True, eq=False)
class Findings:
    """What a report tells. plan: of all steps, left_out: those that the time did not allow; usual: the usual configuration's row."""

    title: str
    about: dict[str, Any]
    rows: dict[str, Row]
    fields: list[Row]
    plan: Sequence[Step]
    left_out: list[str]
    usual: Row

    @property
    def field(self) -> Row | None:
        """The row of the field that the usual configuration is baked from."""
        return next((row for row in self.fields if row["field"] == self.usual["config"]["field"]), None)

    @cached_property
    def paths(self) -> dict[str, list[Point]]:
        """See `summary.knobs`."""
        return knobs(self.rows, self.plan, self.usual["key"])

    @cached_property
    def front(self) -> list[Row]:
        """What nothing beats in quality, time and size at once."""
        return front(list(self.rows.values()), "ms", "megabytes")

    @cached_property
    def predictions(self) -> list[tuple[str, Row, float, float]]:
        """See `summary.predictions`."""
        return predictions(list(self.rows.values()))

    @cached_property
    def stages(self) -> list[tuple[str, Row]]:
        """See `summary.stages`."""
        return stages(self.rows, self.plan, self.field)


def write_plots(found: Findings, folder: Path) -> dict[str, dict[str, bytes]]:
    """Every plot that the rows allow, by name, as {"png", "svg"}; and as files in a folder that exists.

    Raises SnergError where matplotlib is missing, or the folder cannot be written.
    """
    with needs_matplotlib():
        import matplotlib  # noqa: F401
    rows, paths, made = list(found.rows.values()), found.paths, {}
    if paths:
        made["error-and-time"] = error_against_time(rows, paths, found.usual)
        made["rate-and-distortion"] = rate_and_distortion(paths, rows)
    if len(found.stages) > 1:
        made["stages"] = waterfall(found.stages)
    if changes := changed(found):
        made["ablations"] = ablations([(what, gain, half) for what, gain, half, _ in changes])
    if found.predictions:
        made["predictions"] = predicted_and_measured(found.predictions)
    plots = {name: files(figure) for name, figure in made.items()}
    for name, kinds in plots.items():
        for kind, data in kinds.items():
            write_bytes(folder / f"{name}.{kind}", data)
    return plots


def changed(found: Findings) -> list[tuple[str, float, float, Row]]:
    """(what, dB against the usual configuration, half of the interval, row) of each change of one knob alone."""
    result = []
    for knob, path in found.paths.items():
        if any(point.usual for point in path):
            result += [(f"{knob}: {p.value}", *difference(p.row, found.usual), p.row) for p in path if not p.usual]
    return result


def html(found: Findings, plots: dict[str, dict[str, bytes]], pictures: Path) -> str:
    """The report. pictures: the folder of KEY.png and truth.png."""
    parts = [_head(found), _fronts(found, plots), _rates(plots), _stages(found, plots), _ablations(found, plots)]
    parts += [_equal_time(found, pictures), _predictions(found, plots), _paper(found), _table(found), _hardware(found)]
    body = "\n".join(part for part in parts if part)
    title = escape(found.title)
    head = f'<meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _head(found: Findings) -> str:
    usual, about = found.usual, found.about
    lines = [
        f"<h1>{escape(found.title)}</h1>",
        f"<p>{len(found.rows)} configurations of {escape(about['path'])}, measured on {escape(str(usual['views']))} held-out views of "
        f"{escape(about['dataset'])}. The usual configuration reaches <b>{usual['psnr']:.2f} dB</b> (SSIM {usual['ssim']:.3f}) with "
        f"{usual['megabytes']:.1f} MB, {usual['ms']:.0f} ms a frame {_key(usual)}.</p>",
    ]
    lines += [f"<p>{escape(note)}</p>" for note in about.get("notes", [])]
    if found.left_out:
        told = f"{len(found.left_out)} more did not fit into the time; the same command goes on with them"
        lines.append(f"<details><summary>{told}.</summary>{escape(', '.join(found.left_out))}</details>")
    return "\n".join(lines)


def _fronts(found: Findings, plots: dict[str, dict[str, bytes]]) -> str:
    marked = found.front
    cheapest, best = marked[0], max(marked, key=lambda row: row["psnr"])
    text = (
        f"<p>Nothing beats {len(marked)} of the configurations in quality, time and size at once. They lead from "
        f"{cheapest['psnr']:.2f} dB in {cheapest['ms']:.0f} ms and {cheapest['megabytes']:.1f} MB {_key(cheapest)} to "
        f"{best['psnr']:.2f} dB in {best['ms']:.0f} ms and "
        f"{best['megabytes']:.1f} MB {_key(best)}.</p>"
    )
    caption = (
        "Left and down is better. Each line is a knob that was turned alone, through the usual configuration (star); dashed: the front."
    )
    return f"<h2>Error against time</h2>{text}{_figure(plots, 'error-and-time', caption)}"


def _rates(plots: dict[str, dict[str, bytes]]) -> str:
    caption = "Left and up is better. PNG from coarse to fine; the other codecs at the usual resolution, by quality."
    drawn = _figure(plots, "rate-and-distortion", caption)
    return f"<h2>Rate and distortion</h2>{drawn}" if drawn else ""


def _stages(found: Findings, plots: dict[str, dict[str, bytes]]) -> str:
    if "stages" not in plots:
        return ""
    told = ", ".join(f"{name} {row['psnr']:.2f} dB {_key(row)}" for name, row in found.stages)
    about = (
        "<p>Where quality goes between the training images and the web page: the grid alone (floats, nothing culled), what no camera sees "
        "culled, 8 bits a value, the network refined, stored with a lossy codec, and shown as the page shows it (read from its files, rays "
        "end at 1/1024 of the light, 8 bits a pixel).</p>"
    )
    return f"<h2>From the field to the web page</h2>{about}{_figure(plots, 'stages', '')}<p>{told}.</p>"


def _ablations(found: Findings, plots: dict[str, dict[str, bytes]]) -> str:
    if "ablations" not in plots:
        return ""
    rows = "".join(
        f"<tr><td>{escape(what)}</td><td>{_key(row)}</td><td>{gain:+.2f} ± {half:.2f}</td><td>{row['ms']:.0f}</td>"
        f"<td>{row['megabytes']:.1f}</td><td>{making(row):.1f}</td></tr>"
        for what, gain, half, row in changed(found)
    )
    head = "<tr><th>changed</th><th>row</th><th>dB ± 95 %</th><th>ms</th><th>MB</th><th>s to make</th></tr>"
    return f"<h2>One knob at a time</h2>{_figure(plots, 'ablations', '')}<table>{head}{rows}</table>"


def _equal_time(found: Findings, pictures: Path) -> str:
    """Crops of configurations that take as long, the best and the worst, beside the truth, where they differ most."""
    path = pictures / "truth.png"
    rows = [row for row in found.rows.values() if (pictures / f"{row['key']}.png").is_file()]
    if not path.is_file() or len(rows) < 3:
        return ""
    truth, parts = read_image(path), []
    for share in (0.15, 0.5, 0.85):
        level = float(np.quantile([row["ms"] for row in rows], share, method="nearest"))  # a row's own, so that there is one near it
        near = [row for row in rows if level / LIKE <= row["ms"] <= level * LIKE]
        best, worst = max(near, key=lambda row: row["psnr"]), min(near, key=lambda row: row["psnr"])
        if best is worst:
            continue
        shown = [read_image(pictures / f"{row['key']}.png") for row in (best, worst)]
        crop = most_different(*shown)
        tiles = [("truth", truth)] + [
            (f"{r['psnr']:.2f} dB, {r['ms']:.0f} ms {_key(r)}", p) for r, p in zip((best, worst), shown, strict=True)
        ]
        figures = "".join(f"<figure>{_image(enlarged(picture[crop]))}<figcaption>{name}</figcaption></figure>" for name, picture in tiles)
        parts.append(f"<p>About {level:.0f} ms a frame:</p><div class=crops>{figures}</div>")
    return "<h2>At equal time</h2>" + "".join(parts) if parts else ""


def most_different(a: NDArray[Any], b: NDArray[Any]) -> tuple[slice, slice]:
    """Where a window of CROP pixels differs most, of two pictures [H, W, 3]."""
    error = ((a.astype(np.float32) - b.astype(np.float32)) ** 2).sum(axis=-1)
    sums = np.pad(error.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    height, width = min(CROP, a.shape[0]), min(CROP, a.shape[1])
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)


def enlarged(picture: NDArray[Any]) -> NDArray[Any]:
    """ZOOM times as large, pixels as squares."""
    image = Image.fromarray(np.ascontiguousarray(picture[..., :3]))
    return np.asarray(image.resize((ZOOM * image.width, ZOOM * image.height), Image.Resampling.NEAREST))


def _predictions(found: Findings, plots: dict[str, dict[str, bytes]]) -> str:
    if "predictions" not in plots:
        return ""
    told = ", ".join(f"{PREDICTED[name]}: {good} of {count}" for name, (good, count) in accuracy(found.predictions).items())
    return f"<h2>Predicted and measured</h2><p>Within a quarter: {told}.</p>{_figure(plots, 'predictions', 'Grey: within a quarter.')}"


def _paper(found: Findings) -> str:
    parts = []
    for table in tables(found.rows, found.fields, found.plan, found.usual, found.field):
        head = "".join(f"<th>{escape(COLUMN[name])}</th>" for name in table.columns)
        lines = []
        for name, row, published in table.rows:
            ours = "".join(f"<td>{cell(row, column)}</td>" for column in table.columns)
            theirs = ", ".join("—" if value is None else f"{value:g}" for value in published)
            lines.append(f"<tr><td>{escape(name)}</td><td>{_key(row) if row else ''}</td>{ours}<td>{theirs}</td></tr>")
        head = f"<tr><th>{escape(table.title)}</th><th>row</th>{head}<th>published ({escape(table.published)})</th></tr>"
        parts.append(f"<p></p><table>{head}{''.join(lines)}</table>")
    return f"<h2>The paper's tables</h2><p>{escape(WHY)}</p>{''.join(parts)}"


def _table(found: Findings) -> str:
    marked = {row["key"] for row in found.front}
    known = {step.config.key: step.text for step in found.plan}
    head = (
        "<tr><th>row</th><th>what</th><th>PSNR</th><th>SSIM</th><th>ms</th><th>95 %</th><th>MB</th><th>s to make</th><th>peak MB</th></tr>"
    )
    lines = []
    for row in [*found.fields, *sorted(found.rows.values(), key=lambda row: -row["psnr"])]:
        kind = " ".join(name for name, yes in (("usual", row is found.usual), ("front", row["key"] in marked)) if yes)
        peak, made = row.get("peak_megabytes"), f"{making(row):.1f}" if row.get("seconds") else "—"
        lines.append(
            f'<tr class="{kind}"><td>{_key(row)}</td><td>{escape(known.get(row["key"], "the field"))}</td><td>{row["psnr"]:.2f}</td>'
            f"<td>{row['ssim']:.4f}</td><td>{row['ms']:.1f}</td><td>{row['ms_95']:.1f}</td><td>{row['megabytes']:.2f}</td><td>{made}</td>"
            f"<td>{'—' if peak is None else escape(str(peak))}</td></tr>"
        )
    return f"<h2>Every row</h2><p>● on the front of quality, time and size.</p><div class=wide><table>{head}{''.join(lines)}</table></div>"


def _hardware(found: Findings) -> str:
    about = found.about
    settings = ", ".join(f"{name} {value}" for name, value in about["asked"].items() if value is not None)
    lpips = "LPIPS is not measured: no network for it is installed."
    return f"<h2>Machine and settings</h2><p>{escape(machine_line(about['machine']))} {escape(settings)}. {lpips}</p>"


def _figure(plots: dict[str, dict[str, bytes]], name: str, caption: str) -> str:
    if name not in plots:
        return ""
    data = base64.b64encode(plots[name]["svg"]).decode()
    return f'<figure><img alt="{name}" src="data:image/svg+xml;base64,{data}"><figcaption>{escape(caption)}</figcaption></figure>'


def _image(picture: NDArray[Any]) -> str:
    return f'<img alt="" width={picture.shape[1]} src="data:image/png;base64,{base64.b64encode(png_bytes(picture)).decode()}">'


def _key(row: Row) -> str:
    return f"<code>{escape(row['key'])}</code>"
