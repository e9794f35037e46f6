"""Reading the reference's checkpoints: ones written here byte by byte, damaged ones, and the real one where it is."""

import msgpack
import numpy as np
import pytest

from flax_checkpoint import networks, packed, tree, write
from snerg.core.errors import SnergError
from snerg.core.field.reference_checkpoint import read_reference_checkpoint, reference_mlp


@pytest.fixture
def arrays():
    return networks(np.random.default_rng(0))


def test_reads_the_weights_that_were_written(tmp_path, arrays):
    checkpoint = read_reference_checkpoint(write(tmp_path / "checkpoint_7", tree(arrays)))
    assert checkpoint.step == 7 and len(checkpoint.trunk) == 10
    for i, layer in enumerate(checkpoint.trunk):
        assert np.array_equal(layer.kernel, arrays["MLP_2"][f"Dense_{i}"]["kernel"])
        assert np.array_equal(checkpoint.coarse_trunk[i].bias, arrays["MLP_0"][f"Dense_{i}"]["bias"])
    assert np.array_equal(checkpoint.network.weights_2, arrays["MLP_3"]["Dense_3"]["kernel"])
    assert np.array_equal(checkpoint.coarse_network.bias_1, arrays["MLP_1"]["Dense_1"]["bias"])


def test_a_folder_means_its_newest_checkpoint(tmp_path, arrays):
    write(tmp_path / "checkpoint_9", tree(networks(np.random.default_rng(1))))
    write(tmp_path / "checkpoint_10", tree(arrays))
    checkpoint = read_reference_checkpoint(tmp_path)
    assert np.array_equal(checkpoint.trunk[0].kernel, arrays["MLP_2"]["Dense_0"]["kernel"])


def test_reads_arrays_in_chunks(tmp_path, arrays):
    def chunked(array):
        flat = array.reshape(-1)
        parts = {str(i): packed(part) for i, part in enumerate((flat[:5], flat[5:]))}
        return {"__msgpack_chunked_array__": True, "shape": {str(i): n for i, n in enumerate(array.shape)}, "chunks": parts}

    checkpoint = read_reference_checkpoint(write(tmp_path / "checkpoint_1", tree(arrays, chunked)))
    assert np.array_equal(checkpoint.trunk[3].kernel, arrays["MLP_2"]["Dense_3"]["kernel"])


@pytest.mark.parametrize(("width", "depth"), [(8, 4), (24, 6)])
def test_any_width_and_depth(tmp_path, width, depth):
    arrays = networks(np.random.default_rng(2), width, depth)
    checkpoint = read_reference_checkpoint(write(tmp_path / "checkpoint_1", tree(arrays)))
    points = np.zeros((2, 3), np.float32)
    density, colour, features, residual = reference_mlp(np, checkpoint, points, points + 3**-0.5)
    assert density.shape == (2,) and colour.shape == (2, 3) and features.shape == (2, 4) and residual.shape == (2, 3)


@pytest.mark.hard_case(16, 59)
def test_a_tensor_that_is_not_finite_is_named(tmp_path, arrays):
    arrays["MLP_2"]["Dense_4"]["kernel"][3, 3] = np.nan
    with pytest.raises(SnergError, match="MLP_2/Dense_4/kernel"):
        read_reference_checkpoint(write(tmp_path / "checkpoint_1", tree(arrays)))


@pytest.mark.hard_case(62)
def test_a_checkpoint_cut_anywhere_is_refused(tmp_path, arrays):
    data = msgpack.packb(tree(arrays))
    for share in (0, 0.01, 0.3, 0.9, 0.9999):
        (tmp_path / "checkpoint_1").write_bytes(data[: int(len(data) * share)])
        with pytest.raises(SnergError, match="checkpoint_1"):
            read_reference_checkpoint(tmp_path / "checkpoint_1")


def with_array(arrays, value):
    result = tree(arrays)
    result["optimizer"]["target"]["params"]["MLP_2"]["Dense_0"]["kernel"] = value
    return result


HOSTILE = {
    "object": msgpack.ExtType(1, msgpack.packb(((2,), "object", b"\0" * 16))),
    "structured": msgpack.ExtType(1, msgpack.packb(((2,), "f4,O", b"\0" * 16))),
    "too large a shape": msgpack.ExtType(1, msgpack.packb(((2**40, 2**20), "float32", b"\0" * 16))),
    "negative shape": msgpack.ExtType(1, msgpack.packb(((-1, 4), "float32", b"\0" * 16))),
    "not msgpack inside": msgpack.ExtType(1, b"\xc1\xc1"),
    "pickle": msgpack.ExtType(1, b"\x80\x04cos\nsystem\n"),
    "another extension": msgpack.ExtType(77, b""),
    "a number": 3,
    "a list": [1, 2],
    "chunks of chunks": {"__msgpack_chunked_array__": True, "shape": {"0": 1}, "chunks": {}},
    "one dimension": packed(np.zeros(63, "f4")),
    "wrong size": packed(np.zeros((60, 16), "f4")),
}


@pytest.mark.hard_case(62)
@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_arrays_are_refused(tmp_path, arrays, what):
    with pytest.raises(SnergError, match="MLP_2"):
        read_reference_checkpoint(write(tmp_path / "checkpoint_1", with_array(arrays, HOSTILE[what])))


@pytest.mark.parametrize("value", [b"", 5, [], {}, {"optimizer": 3}, {"optimizer": {"target": {"params": {"Dense_0": {}}}}}])
def test_other_msgpack_is_refused(tmp_path, value):
    with pytest.raises(SnergError, match="checkpoint_1"):
        read_reference_checkpoint(write(tmp_path / "checkpoint_1", value))


def test_deep_nesting_is_refused(tmp_path):
    (tmp_path / "checkpoint_1").write_bytes(b"\x91" * 100_000 + b"\x00")
    with pytest.raises(SnergError, match="cut short"):
        read_reference_checkpoint(tmp_path / "checkpoint_1")


def test_no_checkpoint(tmp_path):
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(SnergError, match="no checkpoint"):
            read_reference_checkpoint(path)


def test_a_step_that_is_no_number_is_refused(tmp_path, arrays):
    value = tree(arrays)
    value["optimizer"]["state"]["step"] = "soon"
    with pytest.raises(SnergError, match="step"):
        read_reference_checkpoint(write(tmp_path / "checkpoint_1", value))


def test_the_real_checkpoint_evaluates_as_the_reference_did(data):
    folder = data / "reference" / "checkpoint"
    checkpoint = read_reference_checkpoint(folder)
    with np.load(folder / "ref_eval.npz") as truth:
        density, colour, features, residual = reference_mlp(np, checkpoint, truth["pts"], truth["viewdirs"])
        assert np.abs(density - np.maximum(truth["raw_sigma"][:, 0], 0)).max() < 1e-5
        expected = 1 / (1 + np.exp(-truth["raw_rgb_features"].astype(np.float64)))
        assert np.abs(np.hstack([colour, features]) - expected).max() < 1e-5
        assert np.abs(residual - truth["residual"]).max() < 1e-5
