"""Several devices and several processes train what one does. Each of them is a Python of its own, because JAX's devices are fixed
when it starts."""

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from snerg.core.data.load import read_dataset
from snerg.core.errors import SnergError
from snerg.core.nerf.checkpoint import is_field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, MlpModelConfig
from snerg.core.training.config import TrainSettings
from snerg.core.training.devices import MISSING, connect, device_report, own_address
from snerg.core.training.log import FILE as LOG
from snerg.core.training.parallel import longest_ray, split_batch
from snerg.core.training.trainer import Trainer

SETTINGS = TrainSettings(
    family=HashModelConfig(HashGrid(levels=4, coarsest=8, finest=64, features=4, log2_size=12)),
    view_dependence="deferred",
    samples=2048,
    spacing=2 / 64,
    seconds=None,
    steps=12,
)
HIERARCHICAL = replace(
    SETTINGS, family=MlpModelConfig(width=16, depth=2), sampler="hierarchical", rays=64, coarse=8, fine=8, rays_at_once=16
)

CHILD = """
import hashlib, json, pickle, sys
from pathlib import Path
job = json.loads(sys.argv[1])
if job["processes"] > 1:
    from snerg.core.training.devices import connect
    connect(job["coordinator"], job["processes"], job["process"])
import jax, numpy as np
from dataclasses import replace
from snerg.core.data.load import read_dataset
from snerg.core.training import trainer as train
losses = []
advance = train.Trainer.advance
def logged(self, *more):
    self.state = replace(self.state, loss=0.0)  # so that the running mean is the step's own
    advance(self, *more)
    losses.append(self.state.loss)
train.Trainer.advance = logged
field = train.train(read_dataset(Path(job["dataset"])), pickle.loads(bytes.fromhex(job["settings"])), Path(job["folder"]))
sums = hashlib.sha256(b"".join(np.asarray(a).tobytes() for a in jax.tree.leaves(field.params))).hexdigest()
print(json.dumps({"losses": losses, "devices": len(jax.devices()), "sums": sums}))
"""


def children(dataset: Path, folder: Path, settings: TrainSettings, processes: int, devices: int) -> list[dict]:
    """What each process says at its end."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    job = {"dataset": str(dataset), "settings": pickle.dumps(settings).hex(), "processes": processes, "coordinator": f"127.0.0.1:{port}"}
    environment = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "JAX_PLATFORMS": "cpu"}
    running = []
    for process in range(processes):
        mine = {**job, "process": process, "folder": str(folder / str(process))}
        command = [sys.executable, "-c", CHILD, json.dumps(mine)]
        running.append(subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
    said = []
    for child in running:
        out, err = child.communicate(timeout=500)
        assert child.returncode == 0, err[-3000:]
        said.append(json.loads(out.splitlines()[-1]))
    return said


def losses_of_one(dataset: Path, settings: TrainSettings) -> list[float]:
    trainer = Trainer(read_dataset(dataset), settings)
    losses = []
    while trainer.fraction() < 1:
        trainer.state = replace(trainer.state, loss=0.0)
        trainer.advance()
        losses.append(trainer.state.loss)
    return losses


@pytest.mark.slow
@pytest.mark.parametrize("settings", [SETTINGS, HIERARCHICAL], ids=["packed", "hierarchical"])
def test_four_devices_have_the_losses_of_one(dataset, tmp_path, settings):
    (said,) = children(dataset, tmp_path, settings, 1, 4)
    assert said["devices"] == 4
    np.testing.assert_allclose(said["losses"], losses_of_one(dataset, settings), atol=1e-4)


@pytest.mark.slow
def test_two_processes_have_the_losses_of_one_and_only_the_first_writes(dataset, tmp_path):
    first, second = children(dataset, tmp_path, SETTINGS, 2, 2)
    assert first["devices"] == 4 and first["losses"] == second["losses"] and first["sums"] == second["sums"]
    np.testing.assert_allclose(first["losses"], losses_of_one(dataset, SETTINGS), atol=1e-4)
    assert (tmp_path / "0" / "field.npz").is_file() and (tmp_path / "0" / LOG).is_file()
    assert not (tmp_path / "1").exists()


@pytest.mark.slow
def test_processes_that_follow_the_clock_follow_the_same_one(dataset, tmp_path):
    first, second = children(dataset, tmp_path, replace(SETTINGS, steps=None, seconds=1.0), 2, 1)
    assert first["losses"] == second["losses"] and first["sums"] == second["sums"]


@pytest.mark.slow
def test_one_process_that_is_stopped_stops_the_others_with_a_sentence(dataset, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    small = ["--set", "samples=2048", "--set", "family.grid.levels=4", "--set", "family.grid.log2_size=12"]
    launcher = Path(__file__).parents[3] / "launcher.py"
    command = [sys.executable, str(launcher), "train", str(dataset), "--out", str(tmp_path / "field"), "--minutes", "60", *small]
    together = ["--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process"]
    with ExitStack() as ended:
        running = [subprocess.Popen([*command, *together, str(i)], stderr=subprocess.PIPE, text=True) for i in range(2)]
        for process in running:
            ended.enter_context(process)  # closes its pipe and waits for it
            ended.callback(process.kill)
        next(line for line in running[1].stderr if "Step" in line)
        running[1].send_signal(signal.SIGINT)
        for process in running:
            assert "Stopped together" in process.communicate(timeout=300)[1].splitlines()[-1] and process.returncode == 130
    assert is_field(tmp_path / "field")


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc for what listens")
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_the_coordinator_listens_at_its_own_address_alone(host):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    script = f"from snerg.core.training.devices import connect; connect('{host}:{port}', 2, 0)"
    child = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        end, found = time.monotonic() + 60, []
        while not found and child.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
            lines = [line.split() for file in ("tcp", "tcp6") for line in Path(f"/proc/net/{file}").read_text().splitlines()[1:]]
            found = [words[1] for words in lines if words[3] == "0A" and words[1].endswith(f":{port:04X}")]  # 0A: listening
    finally:
        child.kill()
        child.wait()
    assert {address.split(":")[0][-8:] for address in found} == {"0100007F"}


def test_an_address_that_is_not_this_machines_is_not_listened_at():
    assert own_address("127.0.0.1:8476") == own_address("localhost:8476") == "127.0.0.1:8476"
    assert own_address("192.0.2.7:8476") is None and own_address("node.example:8476") is None


def packed(counts: list[int], size: int, rays: int, seed: int = 0) -> dict:
    """A batch with so many samples a ray."""
    draw = np.random.default_rng(seed)
    ray = np.repeat(np.arange(len(counts)), counts).astype(np.int32)
    used = np.zeros(rays, bool)
    used[ray] = True
    return {
        "inputs": (draw.random((size, 2, 4), np.float32), draw.random((2, 4, size), np.float32)),
        "ray": np.concatenate([ray, np.full(size - len(ray), rays - 1, np.int32)]),
        "valid": np.arange(size) < len(ray),
        "used": used,
        "target": draw.integers(0, 256, (rays, 4), np.uint8),
        "rays": np.float32(used.sum()),
    }


@pytest.mark.parametrize("counts", [[], [5], [1] * 40, [3, 0, 90, 1, 2, 0, 60, 4], [100, 100]])
@pytest.mark.parametrize("parts", [2, 3, 4])
def test_a_batch_is_cut_between_rays_and_nothing_is_lost(counts, parts):
    size, rays = 256, 64
    arrays = packed(counts, size, rays)
    split, whole = split_batch(arrays, parts, 100)
    assert set(whole) == {"target", "rays"}
    assert split["valid"].sum() == sum(counts) and (split["used"].sum(axis=0) == arrays["used"]).all()
    owners = [set(split["ray"][p][split["valid"][p]]) for p in range(parts)]
    assert len(set().union(*owners)) == sum(map(len, owners))  # no ray in two parts
    for p in range(parts):
        assert (np.diff(split["ray"][p]) >= 0).all() and set(np.flatnonzero(split["used"][p])) == owners[p]
    back = np.concatenate([split["inputs"][0][p][split["valid"][p]] for p in range(parts)])
    assert np.array_equal(back, arrays["inputs"][0][: sum(counts)])
    back = np.concatenate([split["inputs"][1][p][..., split["valid"][p]] for p in range(parts)], axis=-1)
    assert np.array_equal(back, arrays["inputs"][1][..., : sum(counts)])


def test_rays_that_cannot_be_divided():
    with pytest.raises(SnergError, match="a multiple of 3"):
        split_batch({"near": np.zeros(64), "rays": np.float32(64)}, 3, 0)


def test_a_part_has_room_for_any_ray_of_the_settings():
    assert longest_ray(SETTINGS) >= 2 * np.sqrt(3) * 32


def test_the_report_says_what_will_be_used():
    report = device_report()
    assert report["jax"] and report["platform"] and len(report["devices"]) >= 1 and report["training"].startswith("Training ")
    json.dumps(report)


def test_the_report_without_jax(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    report = device_report()
    assert report["jax"] is None and report["training"] == MISSING and "pip install jax" in MISSING
    with pytest.raises(SnergError, match="pip install jax"):
        connect("localhost:8476", 2, 0)


@pytest.mark.parametrize(
    "wrong", [("localhost", 2, 0), ("localhost:99999", 2, 0), ("localhost:80", 2, 2), ("localhost:80", 0, 0), ("h:1", 2, -1)]
)
def test_processes_that_make_no_sense(wrong):
    with pytest.raises(SnergError):
        connect(*wrong)
