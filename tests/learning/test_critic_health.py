"""Health of critics: returns against plain loops, and what is called unhealthy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.learning import loop
from drivax.learning.algorithm import training_data
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.offline import critic_problems, policy_returns, returns_to_go
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.experience import ExpertSteps
from drivax.learning.loop import train
from drivax.learning.policies import load_policy
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from drivax.report.pages.report import write_report
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task

OBSERVATION = ObservationConfig(agents=2, steps=1, road=0, lights=1, route=3)
TASK = Task(observation=OBSERVATION, rewards=RewardConfig("behaviour"), metrics="none")


def test_returns_of_a_policy_against_a_plain_loop(data):
    """Of one that brakes in some states and turns off the road in others."""
    bank, driving = ScenarioBank.from_scenarios(data), Driving(Simulator(TASK))

    def act(observation):
        x = observation["route"].reshape(len(observation["route"]), -1).sum(axis=1)
        return jnp.stack([jnp.cos(x), jnp.full_like(x, 0.7)], axis=1)

    run = jax.jit(lambda bank: policy_returns(driving, bank, act, 0.95))
    value, discount, first, final = jax.device_get(run(bank))
    simulator = driving.simulator
    step = jax.jit(lambda state, action: simulator.step(bank, state, action))
    observe = jax.jit(lambda state: driving.observe_all(bank, jax.tree.map(lambda x: x[None], state.context)))
    terminations = 0
    for row in range(len(bank)):
        state = simulator.reset(bank, row)
        expected, factor, is_terminated = 0.0, 1.0, False
        for name, values in observe(state).items():
            np.testing.assert_allclose(first[name][row], values[0], atol=1e-4, err_msg=name)
        for _ in range(bank.steps - 11):
            state, result = step(state, act(observe(state))[0])
            expected += factor * float(result.reward)
            factor *= 0.95
            is_terminated = bool(result.terminated)
            if is_terminated or bool(result.truncated):
                break
        terminations += is_terminated
        assert value[row] == pytest.approx(expected, rel=1e-3, abs=1e-4)
        assert discount[row] == pytest.approx(0.0 if is_terminated else factor, rel=1e-3)
        for name, values in observe(state).items():
            np.testing.assert_allclose(final[name][row], values[0], atol=2e-3, rtol=1e-3, err_msg=name)
    assert terminations


def test_returns_to_go_against_plain_loops():
    rng = np.random.default_rng(0)
    reward = rng.normal(size=(3, 8))
    usable = np.zeros((3, 8), bool)
    usable[0, 1:6], usable[1, 2:8], usable[2, 0:3] = True, True, True
    terminated = np.zeros((3, 8), bool)
    terminated[2, 2] = True
    steps = ExpertSteps(
        jnp.zeros((3, 8, 2)), jnp.asarray(reward, jnp.float32), *map(jnp.asarray, (terminated, ~usable, usable)),
        jnp.asarray(terminated),
    )  # fmt: skip
    final = np.array([2.0, -1.0, 5.0])
    result = np.asarray(returns_to_go(steps, jnp.asarray(final, jnp.float32), 0.9))
    for row, step in zip(*np.nonzero(usable), strict=True):
        last = np.flatnonzero(usable[row])[-1]
        expected = sum(0.9 ** (t - step) * reward[row, t] for t in range(step, last + 1))
        expected += 0.9 ** (last + 1 - step) * (0.0 if terminated[row, last] else final[row])
        assert result[row, step] == pytest.approx(expected, rel=1e-4)


def rows(td_error=(1.0, 0.5, 0.3, 0.2), q_error=0.2, q_rank=0.8, entropy=-2.0, failures=0.3):
    """The log of a run of as many iterations as TD errors."""
    last = {"validation/q_error": q_error, "validation/q_rank": q_rank}
    shared = {"loss/entropy": entropy, "sampler/failures": failures}
    logs = [{"loss/critic": error} | shared for error in td_error]
    return [*logs[:-1], logs[-1] | last]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"td_error": (1.0, 0.5, 0.37, 1.0)}, "the TD error rises over the second half, from 0.37 to 1"),
        ({"q_error": 0.6}, "Q is off by 0.60 standard deviations of the policy's returns"),
        ({"q_rank": 0.3}, "Q has a rank correlation of 0.30 with the returns of held-out episodes"),
        ({"q_error": float("nan")}, "Q is off by nan standard deviations"),
        ({"q_rank": float("nan")}, "Q has a rank correlation of nan"),
        ({"failures": 0.012}, "1.2% of the episodes fail, too few to learn what failures cost"),
        ({"entropy": -0.9}, "the entropy is -0.90, its target -2.00"),
    ],
)
def test_unhealthy_critics_are_named(change, words):
    assert critic_problems(rows(), -2.0) == []
    (problem,) = critic_problems(rows(**change), -2.0)
    assert problem.startswith(words) and "imitates" not in problem
    (problem,) = critic_problems(rows(**change), -2.0, needs_failures=True)
    assert problem.endswith("; the policy only imitates") == ("failures" in change)


def test_runs_without_returns_are_not_checked():
    assert critic_problems([{"loss/critic": 1.0}]) is None
    assert critic_problems(rows(entropy=3.0)) == []


#: Three iterations, after which Q knows nothing.
TINY = {
    "task": {"observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 3}},
    "algorithm": {
        "kind": "iql", "batch": 8, "updates": 1,
        "network": {"encoder": {"rows": [8], "hidden": [16]}, "head": [8]},
    },
    "total_steps": 24,
}  # fmt: skip


@pytest.mark.slow
def test_critics_are_judged_at_the_checkpoint_that_is_loaded(data, tmp_path, monkeypatch):
    """The best is the second of three."""
    scores = iter((0.2, 0.7, 0.5))
    monkeypatch.setattr(loop, "validate", lambda *_: {"validation/vmax_score": next(scores)})
    config = settings.load(TrainConfig, TINY | {"evaluate_every": 1, "checkpoint_rule": "score"})
    run = train(config, data, tmp_path / "run", validation=data)
    rows = run.read_metrics()
    assert len(rows) == 3 and rows[1]["validation/q_error"] != rows[2]["validation/q_error"]
    assert run.info["critics"] == critic_problems(rows[:2]) != critic_problems(rows)


@pytest.mark.slow
def test_policies_of_unhealthy_critics_are_named_so(data, tmp_path):
    """The run says it, and so do the name in tables and the report."""
    lines = []
    run = train(settings.load(TrainConfig, TINY), data, tmp_path / "run", validation=data, log=lines.append)
    row = run.read_metrics()[-1]
    assert row["validation/q_error"] > 0.5 and -1.0 <= row["validation/q_rank"] <= 1.0
    assert any("Q is off by" in problem for problem in run.info["critics"])
    assert any("unhealthy critics: Q is off by" in line for line in lines)
    planner, _ = load_policy(run.path, ScenarioBank.from_scenarios(data))
    assert planner.name == "run (unhealthy critics)"
    page = write_report([run.path], tmp_path / "report.html").read_text()
    assert "Unhealthy critics:" in page and "<li>run: Q is off by" in page


def test_metrics_of_critics_agree_with_their_definition(data):
    """With a critic that is constant, the error is the distance of the constant from the returns."""
    network = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(8,))
    config = IqlConfig(network=network, batch=8, updates=1, gamma=0.9)
    bank, driving = ScenarioBank.from_scenarios(data), Driving(Simulator(TASK))
    learner = config.build(driving, bank, 1)
    experience = training_data(config, driving, bank)
    state = learner.init(experience, jax.random.key(0))
    zeros = jax.tree.map(jnp.zeros_like, state.rest["critic"])
    state.rest["critic"] = zeros
    metrics = learner.held_out_metrics(experience, state)
    returns, *_ = policy_returns(
        driving, bank, lambda o: learner.distribution(state.parameters, o).mode(), 0.9
    )
    returns = np.asarray(returns)
    assert metrics["q_error"] == pytest.approx(np.sqrt(np.mean(returns**2)) / returns.std(), rel=1e-3)
    assert np.isnan(metrics["q_rank"])
