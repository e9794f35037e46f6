"""How to train: every choice that a training has, with its default and where that comes from. No JAX here."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

from ..errors import SnergError
from ..nerf.model import VIEW_DEGREES, VIEWS, HashModelConfig, MlpModelConfig, ModelConfig

MOST_BYTES = 2**31  # of one array of a step; a slip of the finger asks for more
LONG = 480.0  # seconds of training


@dataclass(frozen=True)
class TrainSettings:
    """How to train. Where a default comes from is said behind it; the presets change what their sources change.

    family: the network. ("ours": measured to train best in minutes on two cores.)
    view_dependence: one of networks.VIEWS, or 'auto': 'deferred' (section 4.2) or 'diffuse', whichever the images call for.
    ndc: whether a field lives in the device coordinates of its cameras (NeRF, appendix C), transparency: whether the alpha of images
        bounds what can be where and is learned, backdrop: whether a plain one in opaque images does the former: 'on', 'off' or
        'auto', as the images call for.
    sampler: 'packed', samples at equal distances where something may be (ours), or 'hierarchical', coarse and fine networks
        with samples drawn where the coarse one found something (NeRF, section 5.2).
    hierarchy: of the hierarchical sampler, whether there is a fine network: 'on', 'off' (the evenly spaced samples alone, in one
        network) or 'auto', as the way of the rays calls for.

    Packed: samples in one step, 32768 (ours: XLA's temporaries stay under 32 MB); spacing, the final distance between them on
        [-1, 1], 2 / 256 (ours: the voxels of a small bake); training starts with 8 times that.
    Hierarchical: rays in one step, 8192 (section 6, synthetic scenes; 16384 for real ones); coarse, fine: samples a ray,
        192 and 384 (section 6); distances between the coarse ones, 'linear' (NeRF), or 'disparity', linear in 1 / distance
        (supplement C.2, real 360 degree scenes), or 'auto'; rays_at_once: of a step's rays, how many are in memory together,
        512 (ours: the rest waits its turn, the sum is the same); opaque: the last interval of a ray reaches to infinity, as
        JAXNeRF's does, False (it makes any haze at the far end of the scene a wall).

    background: what stands behind transparent pixels: 'white' (NeRF, synthetic scenes), 'black', 'random', a new colour each ray,
        or '#rrggbb'.
    density_noise: standard deviation of noise on the density before its activation, 0 (NeRF, appendix A: 1 for real scenes).
    sparsity: weight of the Cauchy loss (eq. 8; c = 1/2), averaged over samples as the reference does, 1e-5 (ours: the packed
        samples are those of occupied cells alone; section 4.3: 1e-4, on samples of equal spacing). alpha: weight of the squared
        error of alpha, for images with alpha, 0.1 (ours; the paper has none). hardness: weight of `losses.softness`, summed over a ray,
        5e-4 (ours; packed samples alone): light ends sooner, which bakes to fewer voxels and marches with fewer samples (Lego: a third
        fewer, and better; 1e-3: half, and worse).
    rate, final_rate: of Adam, falling log-linearly, 2e-2 to 3e-3 (ours; section 6: 2e-3 to 2e-5). network_rate: factor on the
        networks beside a hash table, 1 (ours). view_rate: factor on the view-dependence network, 0.3 (ours). view_degrees:
        frequencies of the direction that it sees, 2 (ours; the paper has 4, with which, or at the full rate, a few minutes learn
        by heart what mirrors show the training cameras: other views of one were 1 dB worse). beta_2: 0.99 (ours; JAXNeRF has
        Adam's 0.999). warm_up: steps in which the rate rises from a tenth of itself, 64 (ours; section 6: 2500, from 2e-4).
        average: the last share of the training over which the field is the mean of its parameters, 0.1 (ours: +0.05 dB on Lego after
        five minutes, +0.13 after two, +0.15 where images are few and the training ends by learning their noise; the paper has none).
        clip_value, clip_norm: gradients are cut off at the one and then scaled to the other, None (ours; section 6: 0.01 each).
    seconds, steps: how long to train, 300 seconds; the schedule spans it (section 6: 250000 steps). seed: of everything random.
    """

    family: ModelConfig = HashModelConfig()
    view_dependence: str = "auto"
    ndc: str = "auto"
    transparency: str = "auto"
    backdrop: str = "auto"
    sampler: str = "packed"
    hierarchy: str = "auto"
    samples: int = 32768
    spacing: float = 2 / 256
    rays: int = 8192
    coarse: int = 192
    fine: int = 384
    distances: str = "auto"
    rays_at_once: int = 512
    opaque: bool = False
    background: str = "white"
    density_noise: float = 0.0
    sparsity: float = 1e-5
    alpha: float = 0.1
    hardness: float = 5e-4
    rate: float = 2e-2
    final_rate: float = 3e-3
    network_rate: float = 1.0
    view_rate: float = 0.3
    view_degrees: int = 2
    beta_2: float = 0.99
    warm_up: int = 64
    average: float = 0.1
    clip_value: float | None = None
    clip_norm: float | None = None
    seconds: float | None = 300.0
    steps: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        one_of("view_dependence", self.view_dependence, ("auto", *VIEWS))
        one_of("ndc", self.ndc, ("auto", "on", "off"))
        one_of("transparency", self.transparency, ("auto", "on", "off"))
        one_of("backdrop", self.backdrop, ("auto", "on", "off"))
        one_of("sampler", self.sampler, ("packed", "hierarchical"))
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
        for name in ("clip_value", "clip_norm"):
            if getattr(self, name) is not None:
                _within(name, getattr(self, name), 1e-12, 1e12)
        if not (0 < self.final_rate <= self.rate and math.isfinite(self.rate)):
            raise SnergError(f"The learning rate falls from {self.rate} to {self.final_rate}; both must be above 0, and it must not rise.")
        if self.steps is not None and self.steps < 1:
            raise SnergError(f"Training for {self.steps} steps is no training; give 1 or more.")
        if self.steps is None and not (self.seconds is not None and 0 < self.seconds < math.inf):
            raise SnergError(f"Training for {self.seconds} seconds is no training; give a time above 0, or steps.")
        for name, wanted in (("opaque", self.opaque), ("hierarchy", self.hierarchy == "on")):
            if wanted and self.sampler != "hierarchical":
                raise SnergError(f"The setting {name} is for the hierarchical sampler alone; set sampler=hierarchical with it.")
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


def suited_to_time(settings: TrainSettings) -> TrainSettings:
    """The settings with a hash table twice as large where the training is long enough to fill it (measured: a step takes a
    fifth to two fifths longer; it loses half a decibel after two minutes, and still a little after five)."""
    if not isinstance(settings.family, HashModelConfig) or (settings.seconds or 0) < LONG:
        return settings
    grid = settings.family.grid
    return replace(settings, family=replace(settings.family, grid=replace(grid, log2_size=grid.log2_size + 1)))


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
