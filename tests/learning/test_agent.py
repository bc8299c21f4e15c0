"""Agents in parts: a loop of your own learns the same parameters as ``drivax.train``."""

import os
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning import TrainConfig, make_agent, train
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.tracking.checkpoints import Checkpoints

NETWORK = {"encoder": {"rows": [4], "hidden": [8]}, "head": [4]}
SAC = {
    "kind": "sac", "network": NETWORK, "environments": 2, "unroll": 4, "updates_per_step": 1, "batch": 4,
    "warm_up": 8, "replay": {"capacity": 32},
}  # fmt: skip
PPO = {"kind": "ppo", "network": NETWORK, "environments": 2, "unroll": 4, "epochs": 1, "minibatches": 2}
TASK = {"observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 2}, "metrics": ["success"]}


def config_of(algorithm, iterations):
    return settings.load(
        TrainConfig, {"task": TASK, "algorithm": algorithm, "total_steps": 8 * iterations, "seed": 3}
    )


def own_loop(config, bank):
    """Train step by step, as docs/start/own_loop.md does."""
    agent = make_agent(config, bank)

    @jax.jit
    def iteration(bank, state):
        def step(carry, _):
            now, cache, key = carry
            key, act_key, step_key = jax.random.split(key, 3)
            sampled = agent.sample_action(state, now.observation, act_key)
            drawn = agent.environment.draw(bank, step_key, config.algorithm.environments)
            after, outcome = agent.environment.step(bank, now, cache, sampled.action, drawn)
            return (after, outcome.cache, key), agent.transition(now, sampled, outcome)

        cache = agent.environment.cache(bank, state.environments.state)
        first = (state.environments, cache, agent.rollout_key(state))
        (environments, _, _), rollout = jax.lax.scan(step, first, None, config.algorithm.unroll)
        state = replace(state, environments=environments)
        if not hasattr(agent, "buffer"):
            return agent.update(bank, state, rollout)
        return agent.update(bank, replace(state, replay=agent.buffer.add(state.replay, rollout)))

    first = state = jax.jit(agent.init)(bank, jax.random.key(config.seed))
    for _ in range(config.iterations):
        state, _logs = iteration(bank, state)
    return first, state


def run_optimised(name):
    """Run a test of this file in a process that compiles as users do."""
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        f"{__file__}::{name}",
    ]
    done = subprocess.run(
        command, env=environment | {"DRIVAX_OPTIMISED": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [SAC, PPO], ids=["sac", "ppo"])
def test_own_loop_equals_training(data, algorithm, tmp_path, request):
    if not os.environ.get("DRIVAX_OPTIMISED"):
        # Compiled without optimisation, the two programs round sums differently.
        run_optimised(request.node.name)
        return
    config = config_of(algorithm, 3)
    first, state = own_loop(config, ScenarioBank.from_scenarios(data))
    run = train(config, data, tmp_path / "run", validation=None)
    trained = Checkpoints(run.checkpoints).restore(jax.eval_shape(lambda: state))
    jax.tree.map(np.testing.assert_array_equal, state.parameters, trained.parameters)
    moved = [
        (one != other).any()
        for one, other in zip(*map(jax.tree.leaves, (first.parameters, state.parameters)), strict=True)
    ]
    assert any(moved)


def test_offline_algorithms_and_warm_starts_have_no_agent(data):
    bank = ScenarioBank.from_scenarios(data)
    bc = {"kind": "bc", "network": NETWORK, "batch": 4, "updates": 2}
    bc_ppo = {"kind": "bc_ppo", "warm_start": {"iterations": 1}, "ppo": PPO}
    for algorithm, name in ((bc, "BcConfig"), (bc_ppo, "BcPpoConfig")):
        with pytest.raises(UsageError, match=rf"{name} has no parts for a loop of your own; use ppo or sac"):
            make_agent(config_of(algorithm, 2), bank)


def test_an_agent_in_reactive_traffic_is_made_before_its_bank_is_prepared(data):
    bank = ScenarioBank.from_scenarios(data)
    agent = make_agent(replace(config_of(PPO, 2), traffic="idm"), bank)
    prepared = agent.environment.prepare(bank)
    assert agent.spec == agent.environment.shapes(prepared)
    state = jax.eval_shape(agent.init, prepared, jax.random.key(0))
    assert state.environments.over.shape == (2,)
