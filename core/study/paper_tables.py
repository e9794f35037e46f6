"""The paper's own rows (tables 1, 2, 3 and 5) for a scene, next to the published figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .pareto import StudyRow
from .plan import BITS, NETWORK, REFINE, RESOLUTION, PlanStep

VARIANTS: dict[str, dict[str, Any]] = {  # fields that are trained for these tables alone, as long as the field of the baseline
    "diffuse": {"view_dependence": "diffuse"},
    "no sparsity loss": {"view_dependence": "deferred", "sparsity": 0.0, "hardness": 0.0},
    "tiny": {"view_dependence": "tiny"},
    "sample": {"view_dependence": "sample"},
}
BAKED = ("diffuse", "no sparsity loss")  # those of them that can be baked
PAPER = "the paper's rows"
WHY = (
    "The published figures are of fields trained for 250000 steps on GPUs at 800 x 800 pixels, grids of 1000 voxels a side, and frames "
    "drawn by a laptop's GPU; these are of what this machine trains in minutes, and of frames that NumPy draws on its processor: "
    "milliseconds cannot be compared, ratios between rows can. Ours are refined before a lossy codec, theirs after it. 'No sparsity loss' "
    "leaves out our loss for hard surfaces as well. LPIPS and power are not measured here. Tables 3 and 5 were published as means over "
    "eight scenes, tables 1 and 2 for Lego too (supplement, tables 13, 14, 19 and 20)."
)


TableRow = tuple[str, StudyRow | None, tuple[float | None, ...]]
"""(name, the row measured here or None, the published figures)"""


@dataclass(frozen=True)
class Table:
    """A table of the paper."""

    title: str
    columns: tuple[str, ...]  # of our rows
    published: str  # what the published figures are
    rows: tuple[TableRow, ...]


@dataclass(frozen=True, eq=False)
class _Measured:
    """The rows of a study, by what the tables ask for."""

    rows: dict[str, StudyRow]
    steps: dict[tuple[str, str], StudyRow | None]  # by (parameter, value)
    fields: dict[str, StudyRow]  # rows of the fields themselves, by the field's name
    baseline: StudyRow
    main: StudyRow | None  # the row of the baseline's field

    def step(self, parameter: str, value: str) -> StudyRow | None:
        return self.steps.get((parameter, value))

    def codec(self, name: str) -> StudyRow | None:
        """The best row that differs from the baseline in its codec alone."""
        alike = [row for row in self.rows.values() if _like(row, self.baseline) and row["config"]["codec"]["name"] == name]
        return max(alike, key=lambda row: float(row["psnr"]), default=None)

    @property
    def size(self) -> int:
        return int(self.baseline["config"]["bake"]["resolution"])

    def resolution(self, share: float) -> StudyRow | None:
        """The row at a share of the baseline's resolution."""
        return self.step(RESOLUTION, f"{round(share * self.size)} voxels")


def tables(
    rows: dict[str, StudyRow], fields: Sequence[StudyRow], plan: Sequence[PlanStep], baseline: StudyRow, main: StudyRow | None
) -> list[Table]:
    """Tables 1, 2, 3 and 5 of the paper with what was measured; a row is None where it was not. main: the row of the baseline's field."""
    steps = {(parameter, value): rows.get(step.config.key) for step in plan for parameter, value in step.parameters}
    found = _Measured(rows, steps, {str(row.get("field")): row for row in fields}, baseline, main)
    return [_performance(found), _quality(found), _storage(found), _resolution(found)]


def _performance(found: _Measured) -> Table:
    rows = (
        ("Ours", found.baseline, (9.3, 0.74)),
        ("1) no MLP", found.step(PAPER, "diffuse") or found.step(NETWORK, "none"), (6.0, 0.74)),
        ("2) no sparsity loss", found.step(PAPER, "no sparsity loss"), (25.4, 3.68)),
        ("3) not deferred", found.step(NETWORK, "at every sample"), (261.4, 0.74)),
    )
    return Table("Table 1: performance", ("ms", "memory_gb"), "Lego: ms a frame, GPU GB", rows)


def _quality(found: _Measured) -> Table:
    rows: tuple[TableRow, ...] = (
        ("JAXNeRF+ (NeRF's layers a sample)", found.fields.get("sample"), (35.35, 0.979)),
        ("Tinyview", found.fields.get("tiny"), (34.34, 0.975)),
        ("Deferred", found.main, (34.67, 0.976)),
        ("SNeRG (PNG)", found.baseline, (33.82, 0.973)),
        ("SNeRG (PNG, no sparsity loss)", found.step(PAPER, "no sparsity loss"), (None, None)),
        ("SNeRG (PNG, no FT)", found.step(REFINE, "not refined"), (None, None)),
        ("Diffuse", found.fields.get("diffuse"), (32.17, 0.968)),
    )
    return Table("Table 2: quality", ("psnr", "ssim"), "Lego: PSNR, SSIM", rows)


def _storage(found: _Measured) -> Table:
    rows = (
        ("SNeRG (Float)", found.step(BITS, "32"), (30.47, 0.951, 6883.6)),
        ("SNeRG (PNG, no sparsity loss)", found.step(PAPER, "no sparsity loss"), (30.22, 0.949, 176.0)),
        ("SNeRG (PNG)", found.baseline, (30.38, 0.950, 86.7)),
        ("SNeRG (JPEG)", found.codec("jpeg"), (29.71, 0.939, 70.9)),
        ("SNeRG (H264)", found.codec("h264"), (29.86, 0.938, 30.2)),
        ("the field", found.main, (33.00, 0.962, 18.0)),
    )
    return Table("Table 3: storage", ("psnr", "ssim", "megabytes"), "mean of 8 scenes: PSNR, SSIM, MB", rows)


def _resolution(found: _Measured) -> Table:
    size = found.size
    rows = (
        (f"{size}³ (1000³)", found.baseline, (30.38, 0.950, 84.06, 86.7)),
        (f"{round(0.75 * size)}³ (750³)", found.resolution(0.75), (29.94, 0.947, 89.82, 44.7)),
        (f"{round(0.5 * size)}³ (500³)", found.resolution(0.5), (28.93, 0.939, 101.78, 17.8)),
    )
    return Table("Table 5: resolution", ("psnr", "ssim", "fps", "megabytes"), "mean of 8 scenes: PSNR, SSIM, FPS, MB", rows)


def cell(row: StudyRow | None, column: str) -> str:
    """A number of a row as text, '—' where it is not measured. column: a key of the row, or "fps" or "memory_gb"."""
    if row is None:
        return "—"
    if column == "fps":
        return f"{1000 / max(row['ms'], 1e-3):.2f}"
    if column == "memory_gb":
        return f"{row['memory_megabytes'] / 1000:.2f}" if "memory_megabytes" in row else "—"
    return {"ms": "{:.0f}", "psnr": "{:.2f}", "ssim": "{:.3f}", "megabytes": "{:.1f}"}[column].format(row[column])


def _like(row: StudyRow, baseline: StudyRow) -> bool:
    """Whether a row differs from the baseline in its codec alone."""
    return {**row["config"], "codec": None} == {**baseline["config"], "codec": None}
