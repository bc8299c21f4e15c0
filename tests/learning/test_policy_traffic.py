"""A run folder whose policy drives the vehicles around ego."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import drivax
from drivax import settings
from drivax.errors import DataError
from drivax.learning.config import TrainConfig
from drivax.learning.loop import train
from drivax.learning.policies import PolicyTraffic, open_policy, policy_traffic
from drivax.planners.planner_traffic import TrafficDriver
from drivax.scenario.store import ScenarioSet
from drivax.simulator.traffic.agent_paths import AgentPaths
from drivax.simulator.traffic.bank_data import data_of, prepare_bank
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.synthetic.generate import Generation, generate
from drivax.tracking.run_folder import RunFolder

TINY = {
    "task": {
        "observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 2},
        "rewards": {"preset": "aggressive"},
        "metrics": ["success"],
    },
    "algorithm": {
        "kind": "ppo", "network": {"encoder": {"rows": [4], "hidden": [8]}, "head": [4]},
        "environments": 2, "unroll": 4, "epochs": 1, "minibatches": 1,
    },
    "total_steps": 16,
}  # fmt: skip


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(DataError):
        policy_traffic(tmp_path)


def test_a_run_of_seeds_that_was_killed_at_its_start_is_refused(tmp_path):
    RunFolder.create(tmp_path / "run", TrainConfig(), kind="seeds", seeds=2)
    with pytest.raises(DataError, match=r"no folder seed-N .*; continue the training with --resume"):
        open_policy(tmp_path / "run")


def test_seeds_of_two_runs_are_different_traffic(tmp_path):
    """Episodes are paired by the name of their traffic."""
    names = [PolicyTraffic(run=str(tmp_path / run / "seed-0")).name for run in ("ppo", "sac")]
    assert names == ["driven_by_ppo/seed-0", "driven_by_sac/seed-0"]


@pytest.mark.slow
def test_planner_is_evaluated_among_policy_driven_vehicles(tmp_path):
    generate(tmp_path / "set", 2, 3, Generation(workers=0))
    data = ScenarioSet.open(tmp_path / "set")
    run = train(settings.load(TrainConfig, TINY), data, tmp_path / "bold", validation=None)
    with_logged, with_idm = (policy_traffic(run.path, count=2, base=base) for base in (None, IdmTraffic()))
    assert (with_logged.name, with_idm.name) == ("driven_by_bold", "driven_by_bold+idm")
    assert hash(with_logged) == hash(policy_traffic(run.path, count=2))
    loaded = drivax.load(tmp_path / "set")
    bank = prepare_bank(with_idm, loaded.bank)
    assert data_of(bank, AgentPaths).kinds and data_of(bank, TrafficDriver).planner.name == "bold"
    assert jax.tree.leaves(data_of(bank, TrafficDriver).planner.parameters)
    results = drivax.evaluate("idm", loaded, traffic=with_logged)
    logged = drivax.evaluate("idm", loaded)
    assert results.summary()["traffic"] == "driven_by_bold"
    distance = [table.summary()["metrics"]["average_ttc"]["mean"] for table in (results, logged)]
    assert np.isfinite(distance).all() and distance[0] != distance[1]
