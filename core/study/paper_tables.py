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


@dataclass(frozen=True)
class Table:
    """A table of the paper."""

    title: str
    columns: tuple[str, ...]  # of our rows
    published: str  # what the published figures are
    rows: tuple[tuple[str, StudyRow | None, tuple[float | str | None, ...]], ...]  # (name, our row, the published figures)


def tables(
    rows: dict[str, StudyRow], fields: Sequence[StudyRow], plan: Sequence[PlanStep], baseline: StudyRow, main: StudyRow | None
) -> list[Table]:
    """Tables 1, 2, 3 and 5 of the paper with what was measured; a row is None where it was not. main: the row of the baseline's field."""
    steps = {(parameter, value): rows.get(step.config.key) for step in plan for parameter, value in step.parameters}
    kinds = {row.get("field"): row for row in fields}
    size = baseline["config"]["bake"]["resolution"]

    def codec(name: str) -> StudyRow | None:
        found = [row for row in rows.values() if _like(row, baseline) and row["config"]["codec"]["name"] == name]
        return max(found, key=lambda row: row["psnr"], default=None)

    def resolution(share: float) -> StudyRow | None:
        return steps.get((RESOLUTION, f"{round(share * size)} voxels"))

    speed, quality = ("ms", "memory_gb"), ("psnr", "ssim")
    return [
        Table(
            "Table 1: performance",
            speed,
            "Lego: ms a frame, GPU GB",
            (
                ("Ours", baseline, (9.3, 0.74)),
                ("1) no MLP", steps.get((PAPER, "diffuse")) or steps.get((NETWORK, "none")), (6.0, 0.74)),
                ("2) no sparsity loss", steps.get((PAPER, "no sparsity loss")), (25.4, 3.68)),
                ("3) not deferred", steps.get((NETWORK, "at every sample")), (261.4, 0.74)),
            ),
        ),
        Table(
            "Table 2: quality",
            quality,
            "Lego: PSNR, SSIM",
            (
                ("JAXNeRF+ (NeRF's layers a sample)", kinds.get("sample"), (35.35, 0.979)),
                ("Tinyview", kinds.get("tiny"), (34.34, 0.975)),
                ("Deferred", main, (34.67, 0.976)),
                ("SNeRG (PNG)", baseline, (33.82, 0.973)),
                ("SNeRG (PNG, no sparsity loss)", steps.get((PAPER, "no sparsity loss")), (None, None)),
                ("SNeRG (PNG, no FT)", steps.get((REFINE, "not refined")), (None, None)),
                ("Diffuse", kinds.get("diffuse"), (32.17, 0.968)),
            ),
        ),
        Table(
            "Table 3: storage",
            (*quality, "megabytes"),
            "mean of 8 scenes: PSNR, SSIM, MB",
            (
                ("SNeRG (Float)", steps.get((BITS, "32")), (30.47, 0.951, 6883.6)),
                ("SNeRG (PNG, no sparsity loss)", steps.get((PAPER, "no sparsity loss")), (30.22, 0.949, 176.0)),
                ("SNeRG (PNG)", baseline, (30.38, 0.950, 86.7)),
                ("SNeRG (JPEG)", codec("jpeg"), (29.71, 0.939, 70.9)),
                ("SNeRG (H264)", codec("h264"), (29.86, 0.938, 30.2)),
                ("the field", main, (33.00, 0.962, 18.0)),
            ),
        ),
        Table(
            "Table 5: resolution",
            (*quality, "fps", "megabytes"),
            "mean of 8 scenes: PSNR, SSIM, FPS, MB",
            (
                (f"{size}³ (1000³)", baseline, (30.38, 0.950, 84.06, 86.7)),
                (f"{round(0.75 * size)}³ (750³)", resolution(0.75), (29.94, 0.947, 89.82, 44.7)),
                (f"{round(0.5 * size)}³ (500³)", resolution(0.5), (28.93, 0.939, 101.78, 17.8)),
            ),
        ),
    ]


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
