"""Packs the samples of training on the device, which a GPU would otherwise wait for. Needs JAX.

The host draws the rays of several steps at once; the step itself, on the device, makes their samples and packs those in occupied cells.
The samples are those that `OccupancySampler` packs on the host for the same rays, up to the rounding of float32.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.schema import numbers
from ..nerf.model import field_inputs
from ..nerf.sampling import cell_index, count_steps
from .config import TrainSettings
from .losses import backgrounds
from .occupancy_sampler import MARGIN, OccupancySampler, batch_loss, filled
from .parallel import longest_ray
from .sampler import Batch, BatchLoss, of_any_length
from .termination_depth import DARK

CANDIDATES = 32  # steps of rays, before those in empty cells are left out, for which there is room, for each sample of a batch
MOST_STEPS = 16  # of one dispatch
CPU_SAMPLES, GPU_SAMPLES = 2**17, 2**20  # of one dispatch: it takes a fraction of a second, so that training stops within one
SHARED = ("occupied", "length")  # arrays of a batch that all of its steps share


def packs_on_device(settings: TrainSettings) -> bool:
    """Whether training with these settings packs its samples on the device: where it is one GPU, unless the settings say otherwise.

    Raises SnergError when the settings want it and there are several devices.
    """
    devices = jax.devices()
    if settings.packing == "device" and len(devices) > 1:
        raise SnergError(f"One device can pack samples, and JAX finds {len(devices)}; set packing to auto or host.")
    if settings.packing == "auto":
        return settings.sampler == "packed" and len(devices) == 1 and devices[0].platform != "cpu"
    return settings.packing == "device"


def steps_at_once(samples: int, platform: str) -> int:
    """The number of steps in one dispatch, a power of two up to MOST_STEPS. samples: of one step. It does not depend on the clock."""
    most = (CPU_SAMPLES if platform == "cpu" else GPU_SAMPLES) // samples
    return 1 << min(max(most, 1), MOST_STEPS).bit_length() - 1


class Packed(NamedTuple):
    """The N samples of a step, packed on the device, ray after ray; unused places are last, at the origin and of the last ray."""

    points: Any  # [N, 3] field coordinates
    ray: Any  # int32 [N]
    distance: Any  # [N] from the ray's origin
    valid: Any  # bool [N]
    found: Any  # int32 [R], a ray's samples in occupied cells
    kept: Any  # int32 [R], those of them that are packed: all or none


def pack_on_device(occupied: Any, origins: Any, directions: Any, start: Any, steps: Any, length: Any, size: int, candidates: int) -> Packed:
    """Pack the samples of rays that lie in occupied cells, in JAX: `pack_samples` for arrays of fixed shapes.

    occupied: bool [CELLS^3]. origins, directions: [R, 3]. start: [R], the distance of a ray's first step; steps: int32 [R], their number
    (see `count_steps`); length: between two steps. size: N; candidates: places for steps, at least steps.sum(). From the first ray
    on whose samples do not fit in N places, rays have none.
    """
    ends = jnp.cumsum(steps)
    place = jnp.arange(candidates, dtype=jnp.int32)
    ray = jnp.cumsum(jnp.zeros(candidates, jnp.int32).at[ends].add(1, mode="drop")).clip(max=len(steps) - 1)
    distance = start[ray] + (place - ends[ray] + steps[ray]) * length
    full = (place < ends[-1]) & occupied[cell_index(origins[ray] + directions[ray] * distance[:, None])]
    until = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(full, dtype=jnp.int32)])  # samples before each place
    through, before = until[ends], until[ends - steps]
    found = through - before
    kept = jnp.where(through <= size, found, 0)
    goes = jnp.where(full & (through <= size)[ray], until[:-1], size)  # the place `size` is outside, and is dropped
    chosen = jnp.zeros(size, jnp.int32).at[goes].set(place, mode="drop")
    valid = jnp.arange(size) < kept.sum()
    packed_ray, packed_distance = jnp.where(valid, ray[chosen], len(steps) - 1), jnp.where(valid, distance[chosen], 0)
    points = jnp.where(valid[:, None], origins[packed_ray] + directions[packed_ray] * packed_distance[:, None], 0)
    return Packed(points, packed_ray, packed_distance, valid, found, kept)


class DrawnSteps(NamedTuple):
    """The rays of the last dispatch, as `learn` needs them."""

    tiles: NDArray[Any]  # [steps, rays]
    cut: NDArray[Any]  # bool [steps, rays], by the termination depth
    fits: NDArray[Any]  # bool [steps, rays], the others are dropped
    length: float  # spacing of the samples


def room_for_candidates(settings: TrainSettings) -> int:
    """Places for the steps of a batch's rays, of which those in occupied cells become samples."""
    return max(CANDIDATES * settings.samples, longest_ray(settings))


def packing_loss(settings: TrainSettings, has_alpha: bool, params: Any, batch: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """`batch_loss` of one step's rays, whose samples are packed first.

    aux: "error"; "samples", "rays": how many are packed; "found" [R]: a ray's samples in occupied cells; "used" bool [R]: whether they
    are packed; "end" [R]: where the ray terminated, infinite where it did not.
    """
    origins, along, start, steps = (batch[name] for name in ("origins", "along", "start", "steps"))
    room = room_for_candidates(settings)
    packed = pack_on_device(batch["occupied"], origins, along, start, steps, batch["length"], settings.samples, room)
    inputs = field_inputs(jnp, settings.family, packed.points)
    used, count = packed.kept > 0, packed.kept.sum()
    arrays = {
        "inputs": jax.lax.optimization_barrier(inputs),  # or XLA repeats it for every feature
        "ray": packed.ray,
        "valid": packed.valid,
        "used": used,
        "count": jnp.maximum(count, 1).astype(jnp.float32),
        "rays": jnp.maximum(used.sum(), 1).astype(jnp.float32),
    }
    kept = ("directions", "target", "cut", "length", "background", "diffuse", "noise")
    loss, aux = batch_loss(settings, has_alpha, params, arrays | {name: batch[name] for name in kept if name in batch})
    last = jnp.cumsum(packed.kept) - packed.kept + aux["lit_samples"].astype(jnp.int32).clip(1) - 1
    end = jnp.where(aux["depth"] > -math.log(DARK), packed.distance[last], jnp.inf)
    told = {"error": aux["error"], "samples": count, "rays": used.sum(), "found": packed.found, "used": used, "end": end}
    return loss, told


class DeviceSampler(OccupancySampler):
    """An `OccupancySampler` whose loss packs the samples, and which draws the rays of several steps at once.

    The occupancy grid and the termination depths stay the same during a dispatch and learn from all of its steps.
    samples_per_ray is that at the final spacing. overflow: int64 [2], the rays that were drawn, and those that were dropped because a
    step had no room for their samples.
    """

    def __init__(self, *of: Any) -> None:
        """As `OccupancySampler`."""
        super().__init__(*of)
        self.loss = BatchLoss(packing_loss, of_any_length(self.settings), self.ray_dataset.alpha)
        self.candidates = room_for_candidates(self.settings)
        self.overflow = np.zeros(2, np.int64)

    def batch(self, params: Any, fraction: float) -> Batch:
        """The rays of one step, as `loss` takes them."""
        batch = self.batches(fraction, 1, 1)
        return Batch(step_of(batch.arrays, 0), batch.samples, batch.rays)

    def batches(self, fraction: float, steps: int, places: int) -> Batch:
        """The rays of `steps` steps in arrays [places, R, ...], except for those that are SHARED. How many samples they have is not known
        before they are packed. Raises SnergError when no cell is occupied."""
        if not self.occupied.any():
            raise SnergError("The field has become empty everywhere; check that the images show something inside the box.")
        length, most = self.spacing(fraction), self.most_rays
        rays = int(min(self.settings.samples / (self.samples_per_ray * self.settings.spacing / length), most - 1))
        each = {name: value.reshape(steps, rays, *value.shape[1:]) for name, value in self._rays(steps, rays, length).items()}
        self.drawn_rays = DrawnSteps(each.pop("tile"), each["cut"], each.pop("fits"), length)
        arrays = {name: filled(places, np.stack([filled(most, one) for one in value])) for name, value in each.items()}
        if self.settings.background != "white":
            colours = backgrounds(self.settings.background, steps * most, self.rng)
            arrays["background"] = filled(places, colours.reshape(steps, most, 3))
        if self.settings.density_noise:
            noise = self.rng.standard_normal((steps, self.settings.samples), np.float32)
            arrays["noise"] = filled(places, noise * np.float32(self.settings.density_noise))
        return Batch(arrays | {"occupied": self.occupied, "length": np.float32(length)}, 0, steps * rays, steps)

    def _rays(self, steps: int, rays: int, length: float) -> dict[str, NDArray[Any]]:
        """The rays of several steps, arrays [steps * rays, ...]. Rays that do not fit in a step's candidates have no samples."""
        index = self.ray_dataset.draw(steps * rays, self.rng)
        origin, direction, near, far, view_directions = self.ray_dataset.rays(index)
        tile, offset = self.termination.tile(index), self.rng.random(len(index))
        until = self.termination.depths[tile] + MARGIN * length
        enter, counts, cut = count_steps(self.domain, origin, direction, length, offset, near, far, until)
        fits = (np.cumsum(counts.reshape(steps, rays), axis=1) <= self.candidates).reshape(-1)
        arrays = {
            "tile": tile,
            "fits": fits,
            "origins": origin.astype(np.float32),
            "along": direction.astype(np.float32),
            "start": (enter + offset * length).astype(np.float32),
            "steps": np.where(fits, counts, 0).astype(np.int32),
            "cut": cut & fits,
            "directions": view_directions.astype(np.float32),
            "target": self.ray_dataset.pixels[index],
        }
        return arrays if self.ray_dataset.diffuse is None else arrays | {"diffuse": self.ray_dataset.diffuse[index]}

    def learn(self, params: Any, step: int, aux: dict[str, Any]) -> None:
        """Update the termination depths and the estimate of samples a ray from every step of the last dispatch, which ended with `step`;
        where the occupancy grid was due in one of them, that too."""
        tiles, cuts, fits, length = self.drawn_rays
        steps, rays = tiles.shape
        found, used, end = (np.asarray(aux[name]).reshape(-1, self.most_rays)[:steps, :rays] for name in ("found", "used", "end"))
        for i, tile in enumerate(tiles):
            skipped = tile[cuts[i] & (found[i] == 0)]
            never = np.full(len(skipped), np.inf, np.float32)
            self.termination.learn(np.concatenate([tile[used[i]], skipped]), np.concatenate([end[i][used[i]], never]))
            samples = max(int(found[i].sum()), 1) / max(int(fits[i].sum()), 1)
            self.samples_per_ray = 0.7 * self.samples_per_ray + 0.3 * samples * length / self.settings.spacing
        self.overflow += [tiles.size, int((~fits).sum() + ((found > 0) & ~used).sum())]
        if any(self.is_due(step - i) for i in range(steps)):
            self.update_occupancy(params, step)

    def remark(self) -> str | None:
        """What to tell the user of dropped rays; None where there are none."""
        drawn, dropped = self.overflow
        share = 100 * dropped / max(drawn, 1)
        return f"{share:.1f} % of the rays were drawn and not used: their steps had no room for their samples." if dropped else None

    def state(self) -> dict[str, NDArray[Any]]:
        """What `restore` reads, named arrays of any shape: those of `OccupancySampler`, and the overflow."""
        return super().state() | {"overflow": self.overflow}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Continue from the named arrays of any shape that `state` returned, here or of an `OccupancySampler`.

        Raises ValueError or KeyError on another sampler's.
        """
        super().restore(state)
        overflow = numbers(state.get("overflow", np.zeros(2)), "overflow", (2,))
        self.overflow = overflow.clip(0, 2.0**62).astype(np.int64)


def step_of(arrays: dict[str, Any], index: Any) -> dict[str, Any]:
    """The arrays of one step of a batch of several."""
    return {name: value if name in SHARED else value[index] for name, value in arrays.items()}
