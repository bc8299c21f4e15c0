"""Training PPO: cut off by a signal and resumed, bit for bit; what is never overwritten; what is logged."""

import json
import os
import signal

import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.loop import logged, train
from drivax.learning.stopping import Preempted
from drivax.tracking.sinks import MetricLog, read_rows

SMALL = {
    "task": {
        "observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 3},
        "metrics": ["success"],
    },
    "algorithm": {
        "kind": "ppo",
        "network": {"encoder": {"rows": [8], "hidden": [16]}, "head": [8]},
        "environments": 8, "unroll": 16, "epochs": 2, "minibatches": 2,
    },
    "total_steps": 4 * 8 * 16,
    "checkpoint_every": 3,
}  # fmt: skip


@pytest.fixture(scope="module")
def config():
    return settings.load(TrainConfig, SMALL)


def test_a_run_that_was_told_to_stop_goes_on_bit_for_bit(data, config, tmp_path, monkeypatch):
    whole = train(config, data, tmp_path / "whole")
    write = MetricLog.write

    def write_and_be_told(log, step, values, prefix=""):
        write(log, step, values, prefix)
        if step == 2 * 8 * 16:
            os.kill(os.getpid(), signal.SIGTERM)

    former = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        patch.setattr(MetricLog, "write", write_and_be_told)
        with pytest.raises(Preempted, match="after 384 steps; continue it with --resume") as stopped:
            train(config, data, tmp_path / "cut")
    assert stopped.value.status == 143 and signal.getsignal(signal.SIGTERM) is former
    resumed = train(config, data, tmp_path / "cut", resume=True)
    rows = [list(read_rows(run.metrics)) for run in (whole, resumed)]
    assert [row["step"] for row in rows[0]] == [128, 256, 384, 512] == [row["step"] for row in rows[1]]
    for one, other in zip(*rows, strict=True):
        for name in one:
            if not name.startswith(("time", "steps_per_second")):
                assert one[name] == other[name], name
    # The whole state, by the checksum of every array.
    last = [run.checkpoints / "step-000000512" / "about.json" for run in (whole, resumed)]
    leaves = [json.loads(file.read_text())["leaves"] for file in last]
    assert leaves[0] == leaves[1] and len(leaves[0]) > 50


def test_means_of_an_iteration():
    raw = {
        "rollout/episodes": 4.0, "rollout/steps": 50.0, "rollout/success": 3.0, "rollout/success/n": 4.0,
        "rollout/red_light": 0.0, "rollout/red_light/n": 0.0, "rollout/reward/progress": 5.0, "loss/value": 0.5,
        "loss/critic": 6.0, "loss/critic/n": 3.0, "loss/imitation": 0.0, "loss/imitation/n": 0.0,
    }  # fmt: skip
    assert logged(raw) == {
        "rollout/episodes": 4.0, "rollout/success": 0.75, "reward/progress": 0.1, "loss/value": 0.5,
        "loss/critic": 2.0,
    }  # fmt: skip


def test_settings_that_cannot_be_meant():
    for values, words in (
        ({"traffic": "ldm"}, "there is no traffic 'ldm'"),
        ({"latest_start": 9}, "latest_start is 9; use 10 to 88"),
        ({"patience": 2}, "patience needs validations; set evaluate_every"),
        ({"checkpoint_every": 0}, "checkpoint_every is at least 1"),
        ({"task": {"actions": {"kind": "direct_state"}}}, "cannot learn in direct_state"),
    ):
        with pytest.raises(UsageError, match=words):
            settings.load(TrainConfig, values)


def test_what_is_recorded_of_a_run(data, tmp_path):
    config = settings.load(TrainConfig, {"algorithm": {"kind": "toy_learner:ToyConfig"}, "total_steps": 20})
    train(config, data, tmp_path / "run")
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["kind"] == "training" and info["data"][0]["hash"] == data.hash


@pytest.mark.slow
def test_ppo_learns_to_follow_the_route(data, tmp_path):
    longer = settings.load(TrainConfig, SMALL | {"total_steps": 200_000}, ["--algorithm.environments", "64"])
    rows = list(read_rows(train(longer, data, tmp_path / "run").metrics))
    first, last = (np.mean([row["reward/progress"] for row in part]) for part in (rows[:10], rows[-10:]))
    assert last > 1.5 * first and last > 0.08
