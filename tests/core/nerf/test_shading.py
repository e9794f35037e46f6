"""View dependence of every kind: what is composited of a sample, and what a ray adds."""

import numpy as np
import pytest

import golden
from scenes import looking
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.field import Field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import (
    SHAPES,
    VIEWS,
    HashModelConfig,
    MlpModelConfig,
    ViewNetwork,
    field_inputs,
    field_outputs,
    init_field,
    init_params,
    view_encoding,
    view_head,
    view_residual,
)
from snerg.core.nerf.render import render_field
from snerg.core.nerf.sampling import CELLS, Domain, pack_samples
from snerg.core.nerf.shading import ray_colour, sample_values, unit

FAMILIES = [HashModelConfig(HashGrid(levels=2, log2_size=8), width=16), MlpModelConfig(width=16, depth=3)]
DRAW = np.random.default_rng(0)
POINTS = DRAW.uniform(-1, 1, (20, 3)).astype(np.float32)
TOWARDS = unit(DRAW.normal(size=(20, 3))).astype(np.float32)


def values_of(family, view):
    params = init_field(family, view, np.random.default_rng(1))
    return params, field_outputs(np, family, params["field"], field_inputs(np, family, POINTS))[1]


@pytest.mark.parametrize("family", FAMILIES, ids=["hash", "mlp"])
@pytest.mark.parametrize("view", VIEWS)
def test_nothing_is_carried_that_the_kind_does_not_need(family, view):
    params, values = values_of(family, view)
    assert values.shape[-1] == {"deferred": 7, "diffuse": 3, "sample": family.width, "tiny": 7}[view]
    assert ("view" in params) == (view in ("deferred", "tiny")) and (view_head(family, params["field"]) is None) == (view != "sample")
    assert sample_values(np, view, family, params, values, TOWARDS).shape[-1] == (7 if view == "deferred" else 3)


@pytest.mark.parametrize("family", FAMILIES, ids=["hash", "mlp"])
def test_a_diffuse_field_is_what_is_left_of_a_deferred_one(family):
    """Same arrays, but for the last columns of the last head."""
    import jax

    whole = jax.tree.leaves(init_field(family, "deferred", np.random.default_rng(0))["field"])
    cut = jax.tree.leaves(init_field(family, "diffuse", np.random.default_rng(0))["field"])
    assert [a.shape[:-1] for a in whole] == [b.shape[:-1] for b in cut]
    assert sorted({a.shape[-1] - b.shape[-1] for a, b in zip(whole, cut, strict=True)}) == [0, 4]


@pytest.mark.parametrize("family", FAMILIES, ids=["hash", "mlp"])
def test_nerf_looks_from_a_bottleneck_and_a_direction(family):
    """Section 4.1 and JAXNeRF: concatenated, a ReLU layer of half the width, RGB through a sigmoid."""
    params, values = values_of(family, "sample")
    (kernel, bias), (last, last_bias) = view_head(family, params["field"])
    assert kernel.shape == (family.width + 27, family.width // 2) and last.shape == (family.width // 2, 3)
    hidden = np.maximum(np.hstack([values, view_encoding(np, TOWARDS)]).astype(np.float64) @ kernel + bias, 0)
    expected = 1 / (1 + np.exp(-(hidden @ last + last_bias)))
    assert np.abs(sample_values(np, "sample", family, params, values, TOWARDS) - expected).max() < 1e-6
    assert values.min() < 0  # the bottleneck has no activation


@pytest.mark.parametrize("family", FAMILIES, ids=["hash", "mlp"])
def test_the_tiny_network_a_sample_is_that_of_the_deferred_ray(family):
    """Of a ray that is one opaque sample, Tinyview and Deferred are the same (supplement C.4)."""
    params, values = values_of(family, "tiny")
    seen = sample_values(np, "tiny", family, params, values, TOWARDS)
    opaque = np.zeros(len(values), np.float32)
    assert np.abs(ray_colour(np, "deferred", params, values, opaque, TOWARDS) - seen).max() < 1e-6
    assert np.abs(ray_colour(np, "tiny", params, seen, opaque, TOWARDS) - seen).max() == 0


def test_the_network_sees_the_colour_over_white_whatever_is_behind():
    network = ViewNetwork(*init_field(FAMILIES[0], "deferred", np.random.default_rng(2))["view"])
    gathered, through = DRAW.random((20, 7), np.float32) * 0.5, np.full(20, 0.5, np.float32)
    residual = view_residual(np, network, gathered[:, :3] + 0.5, gathered[:, 3:], TOWARDS)
    behind = DRAW.random((20, 3), np.float32)
    got = ray_colour(np, "deferred", {"view": tuple(network)}, gathered, through, TOWARDS, behind)
    assert np.abs(got - (gathered[:, :3] + 0.5 * behind + residual)).max() < 1e-6
    through[:] = 1
    assert np.abs(ray_colour(np, "deferred", {"view": tuple(network)}, gathered * 0, through, TOWARDS, behind) - behind).max() < 1e-6


@pytest.mark.hard_case(11)
def test_directions_have_length_one():
    assert np.abs(unit(TOWARDS * np.linspace(1e-20, 1e20, 20)[:, None]) - TOWARDS).max() < 1e-6
    for wrong in (np.zeros((1, 3)), np.full((1, 3), np.nan), np.float64([[np.inf, 0, 0]])):
        with pytest.raises(SnergError, match="direction"):
            unit(wrong)


def test_coarse_and_fine_networks_are_two():
    params = init_params(FAMILIES[0], "deferred", True, np.random.default_rng(0))
    assert params["coarse"].keys() == {"field", "view"}
    assert not np.array_equal(params["coarse"]["field"]["weights_0"], params["field"]["weights_0"])
    assert "coarse" not in init_params(FAMILIES[0], "deferred", False, np.random.default_rng(0))


@pytest.mark.parametrize("family", FAMILIES, ids=["hash", "mlp"])
@pytest.mark.parametrize("view", VIEWS)
def test_a_field_of_every_kind_is_rendered_as_it_is_trained(family, view):
    params = init_field(family, view, np.random.default_rng(3))
    network = ViewNetwork(*params["view"]) if "view" in params else None
    domain = Domain(np.zeros(3), 0.5, np.full(3, -1.0), np.full(3, 1.0))
    field = Field(family, params["field"], network, domain, None, 2 / 16, view=view)
    camera = Camera(6, 5, (8.0, 8.0), (3.0, 2.5), looking((5, 1, 2), (0, 0, 0)))
    shown = render_field(field, camera)

    origins, towards = camera.rays()
    samples = pack_samples(domain, np.ones(CELLS**3, bool), origins * 0.5, towards, 2 / 16, np.full(30, 0.5))
    density, values = field_outputs(np, family, params["field"], field_inputs(np, family, samples.points))
    values = sample_values(np, view, family, params, values, towards[samples.ray].astype(np.float32))
    colour, through = np.zeros((30, values.shape[-1])), np.ones(30)
    for ray, thickness, value in zip(samples.ray, density * 2 / 16, values, strict=True):
        colour[ray] += through[ray] * (1 - np.exp(-np.float64(thickness))) * value
        through[ray] *= np.exp(-np.float64(thickness))
    expected = ray_colour(np, view, params, colour.astype(np.float32), through.astype(np.float32), towards.astype(np.float32))
    assert np.abs(shown.over().reshape(-1, 3) - expected).max() < 1e-5
    assert 0 < through.min() < 0.9


@pytest.mark.hard_case(12)
def test_the_view_encoding_is_that_of_float64():
    expected = [golden.encoded(direction.astype(np.float64), 4) for direction in TOWARDS]
    assert np.abs(view_encoding(np, TOWARDS) - expected).max() < 2e-7


def test_the_residual_is_that_of_float64():
    """Inputs are the encoded direction, then the colour over white, then the features (eq. 7)."""
    draw = np.random.default_rng(4)
    network = ViewNetwork(*(draw.normal(0, 0.5, shape).astype(np.float32) for shape in SHAPES))
    colour, features = draw.random((20, 3), np.float32), draw.random((20, 4), np.float32)
    expected = [golden.residual(network, *row) for row in zip(colour, features, TOWARDS, strict=True)]
    assert np.abs(view_residual(np, network, colour, features, TOWARDS) - expected).max() < 1e-6


def test_the_hash_grid_covers_the_domain():
    """Its first vertex lies at -1 and its last at 1; what lies a rounding outside belongs to the border."""
    family = HashModelConfig(HashGrid(levels=1, coarsest=8, finest=8, log2_size=12))
    past = np.float32(1.0000002)
    points = np.float32([[-1, -1, -1], [0, 0, 0], [-past, 0.25, past]])
    indices, weights = field_inputs(np, family, points)
    place = (np.stack(np.unravel_index(indices[0], (10,) * 3), axis=-1) * weights[0][..., None]).sum(axis=1)
    assert place.tolist() == [[0, 0, 0], [4, 4, 4], [0, 5, 8]]
