"""Training by the loop: cut off by a signal and resumed, bit for bit; what is refused, and what is logged."""

import json
import math
import os
import re
import signal
from dataclasses import replace

import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.config import TrainConfig
from drivax.learning.loop import mean_logs, train
from drivax.learning.training_log import Preempted
from drivax.tracking.sinks import MetricLog, read_rows

NETWORK = {"encoder": {"rows": [8], "hidden": [16]}, "head": [8]}
PPO = {"network": NETWORK, "environments": 8, "unroll": 16, "epochs": 2, "minibatches": 2}
#: Learns from its second iteration on; four iterations write over the whole ring.
SAC = {
    "network": NETWORK, "environments": 4, "unroll": 8, "updates_per_step": 1, "batch": 8, "warm_up": 64,
    "replay": {"capacity": 96},
}  # fmt: skip
START = {"iterations": 2, "cloning": {"batch": 8, "updates": 2}, "weight": 0.5, "half_life": 2}
ALGORITHMS = {
    "ppo": PPO,
    "sac": SAC,
    "bc": {"network": NETWORK, "batch": 8, "updates": 2},
    "bc_ppo": {"warm_start": START, "ppo": PPO},
    "bc_sac": {"warm_start": START, "sac": SAC | {"explore": "policy"}},
    "cql": {"network": NETWORK, "batch": 8, "updates": 2, "actions": 2, "gap": 1.0},
    "iql": {"network": NETWORK, "batch": 8, "updates": 2, "records": {"weighted": "policy"}},
    "td3_bc": {"network": NETWORK, "batch": 8, "updates": 3},
    "toy_learner:ToyConfig": {},
}
SMALL = {
    "task": {
        "observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 3},
        "metrics": ["success"],
    },
    "checkpoint_every": 3,
}
#: The loop is the same for every algorithm; iterations of each are resumed in ``test_resume.py``.
KINDS = [
    kind if kind.startswith("toy") else pytest.param(kind, marks=pytest.mark.slow) for kind in ALGORITHMS
]


def config_of(kind, **more):
    return settings.load(TrainConfig, SMALL | {"algorithm": {"kind": kind} | ALGORITHMS[kind] | more})


@pytest.mark.parametrize("kind", KINDS)
def test_preempted_run_resumes_bit_for_bit(data, kind, tmp_path, monkeypatch):
    """Six iterations at one go, and as three, a checkpoint, and three more of a process that starts again."""
    config = config_of(kind)
    each = config.algorithm.steps_per_iteration
    config = replace(config, total_steps=6 * each)
    whole = train(config, data, tmp_path / "whole", validation=None)
    write = MetricLog.write

    def write_and_interrupt(log, step, values):
        write(log, step, values)
        if step == 2 * each:
            os.kill(os.getpid(), signal.SIGTERM)

    former = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        patch.setattr(MetricLog, "write", write_and_interrupt)
        with pytest.raises(
            Preempted, match=f"after {3 * each:,} steps; continue it with --resume"
        ) as stopped:
            train(config, data, tmp_path / "cut", validation=None)
    assert stopped.value.status == 143 and signal.getsignal(signal.SIGTERM) is former
    resumed = train(config, data, tmp_path / "cut", resume=True)
    rows = [list(read_rows(run.metrics)) for run in (whole, resumed)]
    steps = [each * number for number in range(1, 7)]
    assert [row["step"] for row in rows[0]] == steps == [row["step"] for row in rows[1]]
    for one, other in zip(*rows, strict=True):
        assert set(one) == set(other)
        for name in one:
            if not name.startswith(("time", "steps_per_second")):
                assert one[name] == other[name], name
    # The whole state, by the checksum of every array.
    last = [leaves(run, 6 * each) for run in (whole, resumed)]
    assert last[0] == last[1] != leaves(whole, 3 * each) and len(last[0]) >= 3


def leaves(run, step):
    """Checksums of the arrays of a checkpoint."""
    about = run.checkpoints / f"step-{step:09d}" / "about.json"
    return json.loads(about.read_text())["leaves"]


def test_means_of_an_iteration():
    raw = {
        "rollout/episodes": 4.0, "rollout/steps": 50.0, "rollout/success": 3.0, "rollout/success/n": 4.0,
        "rollout/red_light": 0.0, "rollout/red_light/n": 0.0, "rollout/reward/progress": 5.0, "loss/value": 0.5,
        "loss/critic": 6.0, "loss/critic/n": 3.0, "loss/imitation": 0.0, "loss/imitation/n": 0.0,
    }  # fmt: skip
    assert mean_logs(raw) == {
        "rollout/episodes": 4.0, "rollout/success": 0.75, "reward/progress": 0.1, "loss/value": 0.5,
        "loss/critic": 2.0,
    }  # fmt: skip


def test_impossible_settings_are_refused():
    for values, words in (
        ({"traffic": "ldm"}, "unknown traffic 'ldm'; did you mean 'idm'"),
        ({"latest_start": 9}, r"latest_start is 9; use 10 \(earliest_start\) or more"),
        ({"earliest_start": -1}, "earliest_start is -1; use 0 or more"),
        ({"patience": 2}, "patience needs validations; set evaluate_every"),
        ({"total_steps": 0}, "total_steps is 0; use 1 or more"),
        ({"checkpoint_every": 0}, "checkpoint_every is 0; use 1 or more"),
        ({"keep": 0}, "keep is 0; use 1 or more"),
        ({"traffic": {"log": math.nan, "idm": 0.5}}, "shares of traffic are log nan, idm 0.5"),
        ({"task": {"actions": {"kind": "direct_state"}}}, "cannot learn in direct_state"),
        ({"algorithm": {"kind": "ppo", "target_kl": -0.1}}, "target_kl is -0.1; use more than 0"),
        ({"algorithm": {"kind": "ppo", "gamma": 1.5}}, "gamma is 1.5; use 0 to 1"),
        ({"algorithm": {"kind": "ppo", "gradient_norm": 0}}, "gradient_norm is 0.0; use more than 0"),
        ({"algorithm": {"kind": "sac", "temperature": math.nan}}, "temperature is nan; use more than 0"),
        ({"algorithm": {"kind": "bc", "learning_rate": -1e-3}}, "learning_rate is -0.001; use 0 or more"),
        ({"algorithm": {"kind": "iql", "fitted_q": {"batch": 0}}}, "batch is 0; use 1 or more"),
        ({"algorithm": {"kind": "bc_ppo", "warm_start": {"weight": math.nan}}}, "weight is nan; use 0"),
    ):
        with pytest.raises(UsageError, match=words):
            settings.load(TrainConfig, values)


#: Settings that decide how much memory and time a run takes, with a value that a stranger may write: the last one.
HUGE_SIZES = [
    *(f"task: {{observation: {{{name}: 10000000}}}}" for name in ("agents", "road", "lights", "route")),
    "task: {hold: 10000000}",
    "task: {actions: {kind: discrete, accelerations: 1001}}",
    "task: {actions: {kind: discrete, curvatures: 1001}}",
    "start: {kind: noisy_start, tries: 10000000}",
    "algorithm: {kind: bc, network: {head: [10000000]}}",
    "algorithm: {kind: bc, network: {head: [4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, "
    "4, 4, 4, 4, 4, 4, 4, 4]}}",
    *(f"algorithm: {{kind: bc, network: {{encoder: {{{setting}: 10000000}}}}}}" for setting in (
        "kind: lq, latents", "kind: lqh, local_layers", "kind: mtr, layers", "kind: wayformer, layers",
        "kind: lq, heads: 1, width", "kind: mtr, width: 64, heads", "kind: entity, heads: 1, width",
    )),
    *(f"algorithm: {{kind: bc, network: {{encoder: {{{setting}: [10000000]}}}}}}" for setting in (
        "hidden", "rows", "kind: lq, embedding",
    )),
    *(f"algorithm: {{kind: {setting}: 10000000}}" for setting in (
        "ppo, environments", "ppo, unroll", "ppo, epochs", "ppo, minibatches", "sac, environments", "sac, unroll",
        "sac, updates_per_step", "sac, batch", "sac, steps", "bc, batch", "bc, updates", "cql, batch", "iql, updates",
        "td3_bc, batch", "cql, actions", "cql, backup_actions",
    )),
    "algorithm: {kind: sac, replay: {capacity: 1000000000}}",
    "algorithm: {kind: bc_sac, sac: {replay: {capacity: 1000000000}}}",
    "algorithm: {kind: bc_ppo, warm_start: {cloning: {batch: 10000000}}}",
    "algorithm: {kind: iql, fitted_q: {batch: 10000000}}",
    "algorithm: {kind: iql, fitted_q: {updates: 10000000}}",
]  # fmt: skip


@pytest.mark.parametrize("text", HUGE_SIZES)
def test_sizes_have_upper_bounds(text):
    name = "levels" if "discrete" in text else re.findall(r"(\w+): \[?\d", text)[-1]
    with pytest.raises(
        UsageError, match=rf"\b{name}\b.*; .*(use [\d,]+ or less|1 to 1|at most 255)"
    ) as raised:
        settings.load(TrainConfig, settings.parse_yaml(text))
    assert "\n" not in str(raised.value)


def test_steps_of_an_iteration_have_an_upper_bound():
    for config in (PpoConfig, SacConfig):
        with pytest.raises(UsageError, match="steps_per_iteration is 268435456; use 16,777,216 or less"):
            config(environments=1 << 14, unroll=1 << 14)


def test_kinds_of_traffic_have_an_upper_bound():
    shares = {f"runs/{number}": 0.05 for number in range(20)}
    with pytest.raises(UsageError, match="traffic has 20 shares; use 16 or less"):
        settings.load(TrainConfig, {"traffic": shares})


@pytest.mark.slow
def test_run_folder_records_data_and_metrics(data, tmp_path):
    run = train(replace(config_of("ppo"), total_steps=2 * 8 * 16), data, tmp_path / "run", validation=None)
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["kind"] == "training" and info["data"][0]["hash"] == data.hash
    rows = list(read_rows(run.metrics))
    assert [row["step"] for row in rows] == [128, 256]
    assert {"reward/progress", "loss/policy", "loss/value", "loss/entropy"} <= set(rows[0])
    assert all(value is not None for row in rows for value in row.values())


@pytest.mark.slow
def test_ppo_learns_to_follow_the_route(data, tmp_path):
    """12 m/s earn the whole term, and a car that only coasts gets most of it: of what it lacks, half is gained."""
    longer = replace(config_of("ppo", environments=64), total_steps=200_000)
    rows = list(read_rows(train(longer, data, tmp_path / "run", validation=None).metrics))
    whole = longer.task.rewards.weights()["progress"]
    lacks = [whole - np.mean([row["reward/progress"] for row in part]) for part in (rows[:10], rows[-10:])]
    assert 0.0 < lacks[1] < 0.5 * lacks[0], lacks
