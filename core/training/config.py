"""The settings of a training, with their defaults and sources. No JAX here."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

from ..errors import SnergError
from ..io.settings import check_whole, is_whole
from ..nerf.model import VIEW_DEGREES, VIEWS, HashModelConfig, MlpModelConfig, ModelConfig

MOST_BYTES = 2**31  # of one array of a step; a slip of the finger asks for more
LONG = 480.0  # seconds of training from which a larger hash table pays
FINE = 900.0  # seconds of training from which samples as dense as the pixels pay, and the opacity regulariser costs more than it gains
FINEST_SPACING = 2 / 512  # on [-1, 1]; measured: 2 / 1024 has too few rays a step and loses 1 dB


@dataclass(frozen=True)
class TrainSettings:
    """The settings of a training. The comment beside each field says what it is and where its default is from.

    'Ours' is measured on Lego with a few minutes of training on two cores. Sections and supplements are those of the SNeRG paper unless
    another is named; the presets change what their sources change.
    """

    # The network.
    family: ModelConfig = HashModelConfig()  # its model: a hash grid (ours: learns most in minutes) or NeRF's MLP
    view_dependence: str = "auto"  # one of nerf.model.VIEWS, or 'auto': 'deferred' (section 4.2) or 'diffuse', as the images call for

    # What the images decide where it is 'auto'; 'on' or 'off' overrides.
    ndc: str = "auto"  # whether the field lives in normalized device coordinates (NeRF, appendix C)
    transparency: str = "auto"  # whether the images' alpha is trained on and bounds the scene (visual hull)
    depth: str = "off"  # 'on': the cells that views look through, by the dataset's depth, are empty from the first step
    backdrop: str = "auto"  # whether a plain backdrop in opaque images bounds the scene (visual hull)

    # Sampling.
    sampler: str = "packed"  # 'packed': equally spaced samples of occupied cells (ours); 'hierarchical' (NeRF, section 5.2)
    hierarchy: str = "auto"  # hierarchical: 'on': a coarse and a fine network; 'off': one; 'auto': as long as rays need two
    samples: int = 32768  # packed: samples of a step (ours: XLA's temporaries stay under 32 MB)
    packing: str = "auto"  # packed: where samples are packed: 'host', 'device', or 'auto': 'device' on one GPU (which waits for the host)
    spacing: float = 2 / 256  # packed: final distance of samples on [-1, 1] (ours: voxels of a small bake; see `suited`); at first 8 times
    rays: int = 8192  # hierarchical: rays of a step (section 6, synthetic scenes; 16384 for real ones)
    coarse: int = 192  # hierarchical: evenly spaced samples of a ray (section 6)
    fine: int = 384  # hierarchical: samples of a ray that are drawn from the coarse weights (section 6)
    distances: str = "auto"  # coarse samples: 'linear' (NeRF), 'disparity': linear in 1 / distance (supplement C.2), or 'auto'
    rays_at_once: int = 512  # hierarchical: rays in memory together (ours); the sum over a step's rays is the same
    opaque: bool = False  # hierarchical: the last interval is infinite, as in JAXNeRF; off, because it turns far haze into a wall

    # Losses.
    background: str = "white"  # behind transparent pixels: 'white' (NeRF), 'black', 'random' (a colour for each ray) or '#rrggbb'
    density_noise: float = 0.0  # standard deviation of noise on the density before its activation (NeRF, appendix A: 1, real scenes)
    sparsity: float = 1e-5  # weight of the Cauchy loss, eq. 8 (ours: the samples are of occupied cells; section 4.3: 1e-4, of all)
    alpha: float = 0.1  # weight of the squared error of alpha, for images that have it (ours; the paper has none)
    diffuse: float = 0.0  # packed: weight of the error of the diffuse colour, for datasets with that pass; off unless asked for (ours)
    hardness: float = 5e-4  # packed: weight of the opacity regulariser, `losses.softness` (ours: a third fewer voxels; 1e-3 is worse)

    # Optimizer.
    rate: float = 2e-2  # Adam's learning rate at the start (ours; section 6: 2e-3)
    final_rate: float = 3e-3  # and at the end; log-linear between them (ours; section 6: 2e-5)
    network_rate: float = 1.0  # factor on the rate of the networks beside a hash table (ours)
    view_rate: float = 0.3  # factor on the rate of the view-dependence network (ours: at 1 it overfits mirrors in minutes)
    view_degrees: int = 2  # frequencies of the direction's encoding (ours; section 4.2: 4, which overfits as the full rate does)
    beta_2: float = 0.99  # Adam's decay of the second moment (ours; JAXNeRF: 0.999)
    warm_up: int = 64  # steps in which the rate rises from a tenth of itself (ours; section 6: 2500)
    average: float = 0.1  # last share of the training over which parameters are averaged (ours: +0.05 dB after five minutes)
    clip_value: float | None = None  # bound on each value of the gradient (ours: none; section 6: 0.01)
    clip_norm: float | None = None  # bound on the gradient's norm, after clip_value (ours: none; section 6: 0.01)

    # Length.
    seconds: float | None = 300.0  # to train for; the learning rate's schedule spans it
    steps: int | None = None  # to train for, in place of seconds (section 6: 250000)
    seed: int = 0  # of all random numbers

    def __post_init__(self) -> None:
        one_of("view_dependence", self.view_dependence, ("auto", *VIEWS))
        one_of("ndc", self.ndc, ("auto", "on", "off"))
        one_of("transparency", self.transparency, ("auto", "on", "off"))
        one_of("depth", self.depth, ("off", "on"))
        one_of("backdrop", self.backdrop, ("auto", "on", "off"))
        one_of("sampler", self.sampler, ("packed", "hierarchical"))
        one_of("packing", self.packing, ("auto", "host", "device"))
        one_of("hierarchy", self.hierarchy, ("auto", "on", "off"))
        one_of("distances", self.distances, ("auto", "linear", "disparity"))
        if self.background not in ("white", "black", "random") and not re.fullmatch("#[0-9a-fA-F]{6}", self.background):
            raise SnergError(f"The setting background is {self.background!r}; give white, black, random or a colour such as #80ff00.")
        for name, least, most in (
            ("samples", 256, 2**24),
            ("spacing", 1e-4, 0.5),
            ("rays", 1, 2**20),
            ("coarse", 2, 4096),
            ("fine", 1, 4096),
            ("rays_at_once", 1, 2**20),
            ("density_noise", 0, 100),
            ("sparsity", 0, 100),
            ("alpha", 0, 100),
            ("diffuse", 0, 100),
            ("hardness", 0, 100),
            ("network_rate", 0, 100),
            ("view_rate", 0, 100),
            ("view_degrees", 0, VIEW_DEGREES),
            ("beta_2", 0, 0.999999),
            ("warm_up", 0, 2**31),
            ("average", 0, 0.5),
            ("seed", 0, 2**63 - 1),
        ):
            _within(name, getattr(self, name), least, most)
        for name in ("samples", "rays", "coarse", "fine", "rays_at_once", "view_degrees", "warm_up", "seed"):
            check_whole(f"The setting {name}", getattr(self, name), 0, 2**63 - 1)
        for name in ("clip_value", "clip_norm"):
            if getattr(self, name) is not None:
                _within(name, getattr(self, name), 1e-12, 1e12)
        if not (0 < self.final_rate <= self.rate and math.isfinite(self.rate)):
            raise SnergError(f"The learning rate falls from {self.rate} to {self.final_rate}; both must be above 0, and it must not rise.")
        if self.steps is not None and not (is_whole(self.steps) and self.steps >= 1):
            raise SnergError(f"Training for {self.steps} steps trains nothing; give 1 or more.")
        if self.steps is None and not (self.seconds is not None and 0 < self.seconds < math.inf):
            raise SnergError(f"Training for {self.seconds} seconds trains nothing; give a time above 0, or steps.")
        for name, chosen, other in (("diffuse", self.diffuse, "0"), ("packing", self.packing == "device", "auto")):
            if chosen and self.sampler != "packed":
                raise SnergError(f"The setting {name} is only for the packed sampler; set {name} to {other} for the hierarchical one.")
        for name, wanted in (("opaque", self.opaque), ("hierarchy", self.hierarchy == "on")):
            if wanted and self.sampler != "hierarchical":
                raise SnergError(f"The setting {name} is only for the hierarchical sampler; set sampler=hierarchical with it.")
        _check_family(self.family)


def _within(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise SnergError(f"The setting {name} is {value}; it must be from {least:g} to {most:g}.")


def one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise SnergError unless a setting's value is one of the choices."""
    if value not in choices:
        raise SnergError(f"The setting {name} is {value!r}; it must be one of {', '.join(choices)}.")


def _check_family(family: ModelConfig) -> None:
    _within("family.width", family.width, 1, 8192)
    if isinstance(family, MlpModelConfig):
        for name, most in (("depth", 64), ("skip", 64)):
            _within(f"family.{name}", getattr(family, name), 1, most)
        _within("family.degrees", family.degrees, 0, 20)
        one_of("family.density", family.density, ("softplus", "relu"))
        return
    grid = family.grid
    for name, most in (("levels", 32), ("coarsest", 4096), ("features", 16), ("log2_size", 24)):
        _within(f"family.grid.{name}", getattr(grid, name), 1, most)
    _within("family.grid.finest", grid.finest, grid.coarsest, 2**16)
    if grid.rows * grid.features * 4 > MOST_BYTES:
        raise SnergError(
            f"A hash grid of {grid.rows} vertices needs more than {MOST_BYTES >> 30} GiB; lower family.grid.log2_size or levels."
        )


def suited(settings: TrainSettings, pixel: float = FINEST_SPACING) -> TrainSettings:
    """The settings of a hash grid, suited to the time and the pictures.

    pixel: the size of a pixel in field coordinates, as `decisions.pixel_size` estimates it.
    From LONG on, the hash table is twice as large. Measured: with the larger table a step takes 20 to 40 % longer; PSNR is 0.5 dB lower
    after two minutes, and slightly lower after five. From FINE on, samples are as dense as the pixels, FINEST_SPACING at most, and
    there is no opacity regulariser: its weight is constant while the error falls. Measured on Lego at 800 x 800 with equally many rays:
    1.2 dB for twice the density, which takes twice the samples, and 0.2 to 0.4 dB for leaving the regulariser out. After two minutes at
    400 x 400, three halves of the density lose 0.5 dB.
    """
    seconds = settings.seconds or 0
    if not isinstance(settings.family, HashModelConfig) or seconds < LONG:
        return settings
    grid = settings.family.grid
    settings = replace(settings, family=replace(settings.family, grid=replace(grid, log2_size=grid.log2_size + 1)))
    if seconds < FINE:
        return settings
    return replace(settings, spacing=min(settings.spacing, max(pixel, FINEST_SPACING)), hardness=0.0)


_PAPER = TrainSettings(
    family=MlpModelConfig(width=512, depth=8),  # section 6: JAXNeRF+
    view_dependence="deferred",  # section 4.2
    sampler="hierarchical",
    spacing=2 / 512,
    rays=8192,  # section 6
    coarse=192,  # section 6
    fine=384,  # section 6
    sparsity=1e-4,  # section 4.3
    alpha=0.0,
    rate=2e-3,  # section 6, as are the next five
    final_rate=2e-5,
    warm_up=2500,
    clip_value=0.01,
    clip_norm=0.01,
    view_rate=1.0,
    view_degrees=4,  # section 4.2, as in NeRF
    steps=250_000,
    seconds=None,
    beta_2=0.999,  # JAXNeRF
    average=0.0,  # JAXNeRF
)

PRESETS = {
    "fast": TrainSettings(),
    # The paper's own training (section 6). It is meant for several GPUs.
    "paper": _PAPER,
    # JAXNeRF's sizes (supplement C.4: 64 + 128 samples a ray, 256 wide) trained as the paper trains.
    "paper-small": replace(_PAPER, family=MlpModelConfig(width=256, depth=8), coarse=64, fine=128),
    # The paper's kind of network on the packed samples of 'fast', to compare hash grids with.
    "mlp": TrainSettings(family=MlpModelConfig(width=128, depth=4), rate=1e-2, final_rate=1e-3),
}
