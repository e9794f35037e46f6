"""The coefficients of the cost model, in one table: what each multiplies, its unit, and the measurements that it was fitted to.

The field probe measures how fast this machine is; these coefficients relate its small measurements to a whole bake. They are the same on
every machine. `make bench-estimate` compares estimates with measurements, and prints the values that fit them best (bench/fit.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

# bench-estimate on five fields (Lego, fern, fox, and a matte and a mirror-like scene rendered in Blender), 128 to 512 voxels along the
# longest side with 1, 2, 4 and automatic samples a voxel, on a processor with 2 cores. Of 20 configurations the estimates of a bake's
# time and memory were all within 25 %, and 15 of those of a preview's time. Bytes need no coefficient: the probe measures them.
BENCH = "bench-estimate, five fields at 128 to 512 voxels"
BY_HAND = "by hand from the same runs; bench-estimate does not refit it"
PRESETS = "by hand from bench-presets, three fields at 128 and 256 voxels, and Lego at 512"
SET_UP = "by hand from the set-up of two trainings of 20 minutes, 10 s each on two cores, most of it compiling"
TRAININGS = "by hand from single trainings; bench-estimate does not refit it"


def _coefficient(value: float, unit: str, meaning: str, fitted: str) -> Any:
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "fitted": fitted})


@dataclass(frozen=True)
class Coefficients:
    """The table. Each field's metadata has its unit, meaning and where its default was fitted."""

    occupancy_start: float = _coefficient(0.08, "s", "of the occupancy stage of a bake, whatever its size", BENCH)
    prefilter_factor: float = _coefficient(
        1.12, "", "time of a large prefilter stage over that of its parts in the probe: copies, and less use of caches", BENCH
    )
    preview_factor: float = _coefficient(
        0.85, "", "time of a ray of a large preview over that of a ray of the probe, whose rays are further apart", BENCH
    )
    ray_overhead: float = _coefficient(6.0, "samples", "time of a ray apart from its samples, in times of a sample", BY_HAND)
    sample_growth: float = _coefficient(
        0.1, "exponent", "power of the resolution by which a sample's time grows: memory accesses are further apart", BY_HAND
    )
    process_bytes: float = _coefficient(370e6, "bytes", "memory of a bake, whatever its size", PRESETS)
    refine_bytes: float = _coefficient(45e6, "bytes", "memory that fine-tuning adds: its pixels, and JAX's compiled steps", PRESETS)
    cell_copies: float = _coefficient(
        2.7, "", "memory of a bake over the bytes of its atlas: the atlas, the file that resumes the bake, and images to store", PRESETS
    )
    refine_seconds: float = _coefficient(2.0, "s", "of fitting the view-dependence network after its pixels are marched", BY_HAND)
    refine_pixels: float = _coefficient(
        1e6, "rays", "whose time fine-tuning takes: four times RefineSettings.pixels, because they are scattered over the images", BY_HAND
    )
    recorded_ray: float = _coefficient(
        2.0, "rays", "time of a training ray whose samples are recorded over that of a ray of a preview: they are scattered", BY_HAND
    )
    fitted_ray: float = _coefficient(6.0, "rays", "time of fitting voxels to a marched ray once, in rays of a preview", BY_HAND)
    fit_seconds: float = _coefficient(6.0, "s", "of fitting voxels, whatever the rays: compiling, and measuring views kept out", BY_HAND)
    fit_copies: float = _coefficient(6.0, "", "float copies of the fitted voxels: values, two moments and what a step makes", BY_HAND)
    fit_pixel_bytes: float = _coefficient(60.0, "bytes", "memory of a fit for each pixel marched: those that hit have ten samples", BY_HAND)
    step_updates: float = _coefficient(
        1.15, "", "time of a training step over that of an update of its parameters by random samples: rays are drawn", TRAININGS
    )
    set_up_seconds: float = _coefficient(
        10.0, "s", "of a training apart from its steps and reading images: start, visual hull, compiling on two cores, and saving", SET_UP
    )
    training_bytes: float = _coefficient(920e6, "bytes", "memory of a training, whatever its images and parameters", PRESETS)
    parameter_copies: float = _coefficient(
        4.0, "", "float copies of the parameters of a training: Adam's moments, and the gradient", PRESETS
    )
    pixel_bytes: float = _coefficient(3.7, "bytes", "memory of a training for each pixel of its images", PRESETS)


DEFAULT_COEFFICIENTS = Coefficients()


def table(coefficients: Coefficients) -> list[tuple[str, float, str, str, str]]:
    """(name, value, unit, meaning, where the default was fitted) of each coefficient."""
    rows = []
    for entry in fields(coefficients):
        unit, meaning, fitted = (str(entry.metadata[key]) for key in ("unit", "meaning", "fitted"))
        rows.append((entry.name, float(getattr(coefficients, entry.name)), unit, meaning, fitted))
    return rows
