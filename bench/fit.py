"""Fits of the cost model's coefficients to measurements, for `make bench-estimate`.

The model is affine in most coefficients: an estimate with the coefficient at 0 and at 1 gives the line. Each row then gives the value
that would have been exact, and the median over the rows is the fit. The two coefficients of memory are fitted together by least squares.
Coefficients that no row determines keep their values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from common import markdown

from snerg.core.baking.bake import BakeSettings
from snerg.core.baking.finish import Finishing
from snerg.core.study.coefficients import DEFAULT_COEFFICIENTS, Coefficients, table
from snerg.core.study.cost_model import Estimate, estimate
from snerg.core.study.field_probe import FieldProbe


@dataclass(frozen=True, eq=False)
class Measurement:
    """A bake and what was measured of it."""

    probe: FieldProbe
    settings: BakeSettings
    occupancy: float  # seconds of the occupancy stage, compiling included
    prefilter: float  # seconds of the prefilter stage
    preview: float  # seconds of a picture of 800 x 800 pixels
    peak_megabytes: float | None  # of memory, None where the system does not say

    def estimate(self, coefficients: Coefficients) -> Estimate:
        """The estimate of this bake."""
        return estimate(
            self.probe, self.probe.field.domain.world_box(), self.settings, finishing=Finishing(refine=False), coefficients=coefficients
        )


def fit(measurements: Sequence[Measurement]) -> tuple[Coefficients, dict[str, int]]:
    """The coefficients that fit best, and of how many measurements each fitted one is."""
    fixed = [m for m in measurements if m.settings.supersampling]  # the others choose their samples within the prefilter stage
    values: dict[str, list[float]] = {
        "occupancy_start": [_solve(m, "occupancy_start", _occupancy, m.occupancy) for m in measurements],
        "prefilter_factor": [_solve(m, "prefilter_factor", lambda e: e.seconds["prefilter"], m.prefilter) for m in fixed],
        "preview_factor": [_solve(m, "preview_factor", lambda e: e.preview, m.preview) for m in measurements],
    }
    fitted = {name: max(float(np.median(found)), 0.0) for name, found in values.items() if found}
    counts = {name: len(found) for name, found in values.items() if found}
    watched = [m for m in measurements if m.peak_megabytes]
    atlas = np.array([m.estimate(replace(DEFAULT_COEFFICIENTS, process_bytes=0.0, cell_copies=1.0)).peak_megabytes for m in watched])
    if len(set(atlas.tolist())) > 1:
        copies, process = np.polyfit(atlas, [m.peak_megabytes or 0.0 for m in watched], 1)
        fitted |= {"cell_copies": float(copies), "process_bytes": 1e6 * float(process)}
        counts |= {"cell_copies": len(watched), "process_bytes": len(watched)}
    return replace(DEFAULT_COEFFICIENTS, **fitted), counts


def _occupancy(estimated: Estimate) -> float:
    return estimated.seconds["start"] + estimated.seconds["occupancy"]


def _solve(measurement: Measurement, name: str, number: Callable[[Estimate], float], measured: float) -> float:
    """The value of the coefficient `name` with which `number` of the estimate, which is affine in it, is as measured."""
    low, high = (number(measurement.estimate(replace(DEFAULT_COEFFICIENTS, **{name: value}))) for value in (0.0, 1.0))
    return float((measured - low) / (high - low)) if high != low else float(getattr(DEFAULT_COEFFICIENTS, name))


def fit_table(coefficients: Coefficients, counts: dict[str, int]) -> str:
    """Every coefficient as Markdown: its value now, the fitted one and of how many rows, its unit, and where the value now is from."""
    rows = []
    for (name, value, unit, _, fitted), (_, better, *_) in zip(table(DEFAULT_COEFFICIENTS), table(coefficients), strict=True):
        found = f"{better:.3g} ({counts[name]} rows)" if name in counts else None
        rows.append([f"`{name}`", f"{value:.3g}", found, unit or "factor", fitted])
    return markdown("coefficient, value now, fitted here, unit, fitted to", rows)
