"""Reading the reference's checkpoints: ones written here byte by byte, damaged ones, and the real one where it is."""

import io
import pickle
import tracemalloc

import msgpack
import numpy as np
import pytest

from flax_checkpoint import encode, evaluate, logistic, networks, packed, tree, write
from snerg.core.artifact import kind_of
from snerg.core.errors import SnergError
from snerg.core.nerf.reference_checkpoint import field_of, read_reference_checkpoint, reference_mlp


@pytest.fixture
def arrays():
    return networks(np.random.default_rng(0))


def test_reads_the_weights_that_were_written(tmp_path, arrays):
    checkpoint = read_reference_checkpoint(write(tmp_path / "checkpoint_7", tree(arrays)))
    assert checkpoint.step == 7 and len(checkpoint.trunk) == 10
    for i, layer in enumerate(checkpoint.trunk):
        assert np.array_equal(layer.kernel, arrays["MLP_2"][f"Dense_{i}"]["kernel"])
        assert np.array_equal(layer.bias, arrays["MLP_2"][f"Dense_{i}"]["bias"])
    assert np.array_equal(checkpoint.network.weights_2, arrays["MLP_3"]["Dense_3"]["kernel"])


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


SIZES = {
    "narrow": {"width": 8, "depth": 4},
    "wide": {"width": 40, "depth": 6},
    "deep": {"width": 12, "depth": 13, "skip": 3},
    "one layer": {"width": 12, "depth": 1},
    "skip into the heads": {"width": 12, "depth": 5, "skip": 4},
    "skip after every layer": {"width": 12, "depth": 3, "skip": 1, "view": (16, 1, 4)},
    "no skip": {"width": 12, "depth": 3, "skip": 4},
    "few degrees": {"degrees": 5},
    "no encoding": {"degrees": 0, "view": (16, 2, 0)},
    "narrow view network": {"view": (7, 2, 4)},
    "shallow view network": {"view": (16, 1, 4)},
    "small everywhere": {"width": 5, "depth": 2, "skip": 2, "degrees": 2, "features": 2, "view": (3, 1, 1)},
    "no features": {"features": 0},
    "diffuse": {"features": 0, "view": None},
    "diffuse, coarse only": {"features": 0, "view": None, "fine": False},
}


@pytest.mark.parametrize("name", SIZES)
def test_any_width_depth_skip_and_degree(tmp_path, name):
    """Each against the networks restated in float64, straight from the arrays as they were written."""
    size = SIZES[name]
    arrays = networks(np.random.default_rng(2), **size)
    checkpoint = read_reference_checkpoint(write(tmp_path / "checkpoint_1", tree(arrays)))
    random = np.random.default_rng(3)
    points, directions = random.uniform(-1.2, 1.2, (50, 3)), random.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    density, colour, features, residual = reference_mlp(np, checkpoint, np.float32(points), np.float32(directions))

    view, skip, count = size.get("view", (16, 2, 4)), size.get("skip", 4), size.get("features", 4)
    baked = sorted(arrays)[-1 if view is None else -2]
    raw_density, raw = evaluate(arrays[baked], encode(np.float32(points), size.get("degrees", 10)), skip)
    values = logistic(raw)
    assert np.abs(density - np.maximum(raw_density, 0)).max() < 2e-4
    assert np.abs(colour - values[:, :3]).max() < 2e-4 and np.abs(features[:, :count] - values[:, 3:]).max(initial=0) < 2e-4
    if view is None:
        assert checkpoint.network is None and features.shape == (50, 0) and not residual.any()
    else:
        inputs = np.concatenate([encode(np.float32(directions), view[2]), values], axis=-1)
        assert np.abs(residual - logistic(evaluate(arrays[sorted(arrays)[-1]], inputs, skip)[1])).max() < 2e-4
        assert features.shape == (50, 4)


@pytest.mark.parametrize(
    ("size", "reason"),
    [
        ({"features": 5}, "up to 4 features"),
        ({"view": (17, 2, 4)}, "34 -> 16"),
        ({"view": (16, 3, 4)}, "34 -> 16"),
        ({"view": (16, 2, 5)}, "34 -> 16"),
        ({"view": (16, 2, 4), "skip": 1}, "34 -> 16"),
        ({"fine": False}, "without fine samples"),
        ({"features": 4, "view": None}, "without fine samples"),
    ],
)
def test_what_a_scene_cannot_hold_is_refused(tmp_path, size, reason):
    with pytest.raises(SnergError, match=reason):
        read_reference_checkpoint(write(tmp_path / "checkpoint_1", tree(networks(np.random.default_rng(2), **size))))


def per_sample(random, width=8, depth=8, encoded=63, bottleneck=True):
    """The MLP of JAXNeRF and mip-NeRF: density, bottleneck, then a layer that sees the direction."""
    rows = [encoded] + [width + encoded if i > 0 and i % 4 == 0 else width for i in range(depth)]
    shapes = [(r, width) for r in rows[:depth]] + [(rows[depth], 1), (rows[depth], width), (width + 27, 6), (6, 3)]
    return {f"Dense_{i}": {"kernel": np.float32(random.normal(size=s)), "bias": np.zeros(s[1], "f4")} for i, s in enumerate(shapes)}


def test_checkpoints_of_other_nerfs_are_refused_by_their_kind(tmp_path):
    random = np.random.default_rng(0)
    jaxnerf = {name: per_sample(random) for name in ("MLP_0", "MLP_1")}
    mipnerf = {"MLP_0": per_sample(random, encoded=96)}
    for arrays in (jaxnerf, mipnerf):
        with pytest.raises(SnergError, match="direction at every sample"):
            read_reference_checkpoint(write(tmp_path / "checkpoint_1", tree(arrays)))
    with pytest.raises(SnergError, match="holds GridMLP_0"):
        read_reference_checkpoint(write(tmp_path / "checkpoint_1", tree({"GridMLP_0": per_sample(random)})))


def other_files():
    archive = io.BytesIO()
    np.savez(archive, weights=np.zeros(3))
    array = io.BytesIO()
    np.save(array, np.zeros(3))
    return {
        "a pickle": pickle.dumps({"optimizer": 1}),
        "a zip archive": archive.getvalue(),
        "a NumPy array": array.getvalue(),
        "an HDF5 file": b"\x89HDF\r\n\x1a\n" + b"\0" * 50,
        "JSON": b' {"optimizer": {}}',
        "not a checkpoint": b"\x89PNG\r\n\x1a\n" + b"\0" * 50,
    }


@pytest.mark.hard_case(62)
@pytest.mark.parametrize("what", other_files())
def test_other_files_are_refused_by_what_they_are(tmp_path, what):
    (tmp_path / "checkpoint_1").write_bytes(other_files()[what])
    with pytest.raises(SnergError, match=f"checkpoint_1 is {what}"):
        read_reference_checkpoint(tmp_path / "checkpoint_1")


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


LIES = {
    "array of 4 billion": b"\xdd\xff\xff\xff\xff",
    "array as long as the file": b"\xdd\x00\x20\x00\x00",
    "map of 4 billion": b"\xdf\xff\xff\xff\xff",
    "extension of 4 GB": b"\xc9\xff\xff\xff\xff\x01",
    "bytes of 4 GB": b"\xc6\xff\xff\xff\xff",
    "text of 4 GB": b"\xdb\xff\xff\xff\xff",
    "a thousand arrays, one in another": b"\xdd\x00\x20\x00\x00" * 1000,
}


@pytest.mark.hard_case(62)
@pytest.mark.parametrize("what", LIES)
def test_sizes_that_lie_take_no_memory(tmp_path, what):
    data = b"\x81\xa9optimizer" + LIES[what]
    (tmp_path / "checkpoint_1").write_bytes(data + b"\x00" * (2**21 - len(data)))
    tracemalloc.start()
    try:
        with pytest.raises(SnergError, match="checkpoint_1"):
            read_reference_checkpoint(tmp_path / "checkpoint_1")
        assert tracemalloc.get_traced_memory()[1] < 2**23
    finally:
        tracemalloc.stop()


@pytest.mark.hard_case(62)
def test_an_enormous_file_is_refused_unread(tmp_path):
    with open(tmp_path / "checkpoint_1", "wb") as file:
        file.truncate(2**33)  # sparse: it has no bytes on the disk
    with pytest.raises(SnergError, match="larger than 512 MiB"):
        read_reference_checkpoint(tmp_path / "checkpoint_1")


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


@pytest.mark.parametrize("place", ["TrainState", "variables", "params alone", "the networks alone"])
def test_checkpoints_of_newer_flax_are_read(tmp_path, arrays, place):
    """flax.optim is gone from newer versions: a TrainState holds the networks under params."""
    params = tree(arrays)["optimizer"]["target"]["params"]
    state = {"step": 7, "params": {"params": params}, "opt_state": {"0": {"count": packed(np.int32(7))}}}
    value = {
        "TrainState": state,
        "variables": {"params": params},
        "params alone": {"step": 7, "params": params},
        "the networks alone": params,
    }
    new = read_reference_checkpoint(write(tmp_path / "checkpoint_7", value[place]))
    old = read_reference_checkpoint(write(tmp_path / "checkpoint_8", tree(arrays)))
    assert new.step == (7 if "step" in value[place] else 0)
    for mine, theirs in zip(new.trunk, old.trunk, strict=True):
        assert np.array_equal(mine.kernel, theirs.kernel) and np.array_equal(mine.bias, theirs.bias)


@pytest.mark.parametrize("layout", ["item", "steps", "flax with Orbax"])
def test_orbax_checkpoints_say_what_to_write(tmp_path, layout):
    mark = {"item": "manifest.ocdbt", "steps": "1000/default/manifest.ocdbt", "flax with Orbax": "checkpoint_1000/_METADATA"}[layout]
    file = tmp_path / "run" / mark
    file.parent.mkdir(parents=True)
    file.write_bytes(b"{}")
    if layout == "steps":
        (tmp_path / "run/1000/_CHECKPOINT_METADATA").write_text("{}")
    assert kind_of(tmp_path / "run") == "checkpoint"
    with pytest.raises(SnergError, match=r"Orbax checkpoint.*msgpack_serialize"):
        read_reference_checkpoint(tmp_path / "run")


def test_other_trees_say_what_they_hold_and_what_to_write(tmp_path):
    with pytest.raises(SnergError, match=r"it holds model_state, rng, and no networks.*msgpack_serialize"):
        read_reference_checkpoint(write(tmp_path / "checkpoint_1", {"rng": 1, "model_state": {"params": 3}}))


def test_the_extent_is_that_of_the_configuration(tmp_path, arrays):
    """The published default is 1.7; a configuration beside the checkpoint may state another."""
    path = write(tmp_path / "checkpoint_7", tree(arrays))
    assert field_of(read_reference_checkpoint(path), "here").domain.world_box().size.tolist() == pytest.approx([3.4] * 3)
    (tmp_path / "blender.yaml").write_text("dataset: blender\nsnerg_box_scale: 1.2  # tight\nvoxel_resolution: 800\n")
    assert field_of(read_reference_checkpoint(path), "here").domain.world_box().size.tolist() == pytest.approx([2.4] * 3)
    (tmp_path / "blender.yaml").write_text("snerg_box_scale: .inf\n")
    assert read_reference_checkpoint(path).box_scale == 1.7
