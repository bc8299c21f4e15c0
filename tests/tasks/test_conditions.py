"""Conditions: draws per agent and episode, fixed in evaluation, no change without them."""

from dataclasses import replace
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import cli, load, settings
from drivax.errors import UsageError
from drivax.evaluation.rollout import evaluation_task
from drivax.evaluation.runner import EvaluationConfig, evaluate
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.environment import collect
from drivax.learning.policies import export_policy, load_policy
from drivax.planners.planner import Memoryless
from drivax.scenario.record import record
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import LogTraffic
from drivax.synthetic.generate import Generation, generate
from drivax.tasks.conditions import Condition, check_conditions, fix_conditions, parse_values
from drivax.tasks.observations import OwnGroup
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from scenes import GLIMPSE, RED, bank_of, car, straight_road
from tiny_run import TINY, write_run

COLLISION = Condition("collision", 0.5, 2.0)
SPEED = Condition("desired_speed", 0.7, 1.2)
GAP = Condition("time_gap_s", 0.8, 2.5, 1.5)
CONDITIONS = (COLLISION, SPEED, GAP)
REWARDS = RewardConfig(preset="safety", excess_speed=-0.5, time_gap_shortfall=-0.2)
TASK = Task(observation=GLIMPSE, rewards=REWARDS, conditions=CONDITIONS, metrics="none")
YAML = {
    "rewards": {"preset": "safety", "excess_speed": -0.5},
    "conditions": [{"name": "collision", "low": 0.5, "high": 2}, {"name": "desired_speed", "low": 0.7, "high": 1.2}],
}  # fmt: skip


@pytest.fixture(scope="module")
def bank():
    return bank_of(straight_road([car(0, 0, 0, 9), car(40, 0, 0, 9)]), straight_road([car(5, 3.7, 0, 7)]))


def test_time_gap_by_hand():
    """At 10 m/s, 30 m behind a car of ego's length, 4.8 m: 2.52 s. Neither the next lane nor a red light counts."""
    scenes = [
        ([car(0, 0, 0, 10), car(30, 0, 0, 8)], {}, 2.52),
        ([car(0, 0, 0, 10), car(30, 3.7, 0, 8)], {}, 10.0),
        ([car(0, 0, 0, 10), car(-30, 0, 0, 10)], {}, 10.0),
        ([car(0, 0, 0, 10)], {"light": RED, "light_x": 20.0}, 10.0),
        ([car(0, 0, 0, 0), car(8, 0, 0, 0)], {}, 10.0),
        ([car(0, 0, 0, 1), car(80, 0, 0, 0)], {}, 10.0),
    ]
    bank = bank_of(*(straight_road(cars, **light) for cars, light, _ in scenes))
    simulator = Simulator(replace(TASK, ends=()))
    measure = jax.jit(jax.vmap(lambda bank, row: simulator.reset(bank, row).facts.time_gap_s, (None, 0)))
    gaps = measure(bank, jnp.arange(len(scenes)))
    np.testing.assert_allclose(gaps, [gap for *_, gap in scenes], atol=0.01)
    assert Simulator(Task()).task.reads.isdisjoint({"time_gap_s"})


def test_draws_are_uniform_per_key_and_agent():
    draw = jax.jit(jax.vmap(TASK.draw_conditions))
    keys = jax.random.split(jax.random.key(3), 2000)
    values = np.asarray(draw(jnp.zeros(2000, jnp.int32), keys))
    np.testing.assert_array_equal(values, draw(jnp.zeros(2000, jnp.int32), keys))
    low, high = np.array([(c.low, c.high) for c in CONDITIONS]).T
    assert (values >= low).all() and (values <= high).all()
    shares = np.sort((values - low) / (high - low), axis=0)
    # Kolmogorov-Smirnov at the 0.1 % level.
    assert np.abs(shares - np.linspace(0, 1, 2000)[:, None]).max() < 1.95 / np.sqrt(2000)
    assert np.abs(np.corrcoef(values.T) - np.eye(3)).max() < 0.1
    other = np.asarray(draw(jnp.ones(2000, jnp.int32), keys))
    assert (other != values).all()


def test_without_a_key_or_if_fixed_the_number_is_that_of_evaluation():
    np.testing.assert_array_equal(TASK.draw_conditions(0, None), np.float32([1.0, 1.0, 1.5]))
    mixed = replace(TASK, conditions=(replace(COLLISION, fixed=True), SPEED))
    values = mixed.draw_conditions(0, jax.random.key(0))
    assert float(values[0]) == 1.0 and float(values[1]) != 1.0
    fixed = evaluation_task(TASK).draw_conditions(0, jax.random.key(0))
    np.testing.assert_array_equal(fixed, np.float32([1.0, 1.0, 1.5]))


def test_observation_is_scaled_by_the_range(bank):
    simulator = Simulator(TASK)

    @jax.jit
    def observe(bank, conditions):
        return simulator.observe(bank, replace(simulator.context(bank, 0), conditions=conditions))

    for values, scaled in (([0.5, 0.7, 0.8], [-1, -1, -1]), ([2.0, 0.95, 1.65], [1, 0, 0])):
        obs = observe(bank, jnp.array(values, jnp.float32))
        np.testing.assert_allclose(obs["conditions"], scaled, atol=1e-6)
    assert Driving(simulator).shapes(bank)["conditions"] == (3,)
    assert "conditions" not in Driving(Simulator(replace(TASK, conditions=()))).shapes(bank)


def test_without_conditions_no_number_is_drawn_or_carried(bank):
    simulator = Simulator(replace(TASK, conditions=()))

    def start(bank, key):
        return simulator.new_episode(bank, 0, key=key)

    program = jax.make_jaxpr(start)(bank, jax.random.key(0))
    assert "random" not in str(program) and "threefry" not in str(program)
    context = jax.eval_shape(start, bank, jax.random.key(0)).context
    assert context.conditions == () and len(jax.tree.leaves(context)) == 7


def test_neutral_numbers_change_no_bit(bank):
    """A factor of 1 and the options of the configuration."""

    @partial(jax.jit, static_argnums=0)
    def drive(task, bank):
        simulator = Simulator(task)

        def step(state, action):
            after, transition = simulator.step(bank, state, action)
            return after, (after.context.history[-1], transition.reward, transition.reward_terms)

        return jax.lax.scan(step, simulator.reset(bank, 0), jnp.full((20, 2), 0.3))[1]

    plain, neutral = (drive(replace(TASK, conditions=conditions), bank) for conditions in ((), CONDITIONS))
    assert float(plain[2]["time_gap_shortfall"].min()) == 0.0
    jax.tree.map(np.testing.assert_array_equal, plain, neutral)


def test_an_episode_keeps_its_draw_and_the_next_has_another(bank):
    driving = Driving(Simulator(TASK), latest_start=40)

    def actor(observation, key):
        action = jnp.ones((4, 2))
        return action, action, {}

    @jax.jit
    def run(bank, key):
        rollout = collect(driving, bank, driving.start(bank, key, 4), actor, key, 90, "state")[1]
        return rollout.state.conditions, rollout.alive

    (values, alive), (again, _) = (jax.device_get(run(bank, jax.random.key(0))) for _ in range(2))
    assert values.shape == (90, 4, 3) and (~alive).sum() >= 4
    np.testing.assert_array_equal(values, again)
    changes = (values[1:] != values[:-1]).all(axis=-1)
    same = (values[1:] == values[:-1]).all(axis=-1)
    # The row after one that only resets is the first of a new episode.
    np.testing.assert_array_equal(changes, ~alive[:-1])
    np.testing.assert_array_equal(same, alive[:-1])
    assert len(np.unique(values[0, :, 0])) == 4


@record
class Obedient(Memoryless):
    """Accelerate by the observed desired speed."""

    name: ClassVar[str] = "obedient"

    def act(self, carry, bank, state, situation, observation, key):
        return jnp.stack([0.3 * observation["conditions"][1], jnp.zeros(())]), carry


@pytest.mark.slow
def test_evaluation_has_fixed_numbers(bank):
    names = [{"dataset": "d", "scenario_id": str(i), "segment": str(i)} for i in range(2)]
    run = partial(evaluate, Obedient(), bank, names)
    by_seed = [run(task=TASK, seed=seed).metrics["progress"] for seed in (0, 1)]
    np.testing.assert_array_equal(*by_seed)
    slow, fast = (
        replace(TASK, conditions=fix_conditions(CONDITIONS, {"desired_speed": v})) for v in (0.7, 1.2)
    )
    assert (run(task=slow).metrics["progress"] < run(task=fast).metrics["progress"]).all()


def algorithm(kind):
    small = {"environments": 2, "unroll": 8}
    sac = {
        "kind": "sac",
        "network": TINY["algorithm"]["network"],
        "batch": 4,
        "replay": {"capacity": 32},
        "warm_up": 16,
    }
    return (TINY["algorithm"] if kind == "ppo" else sac) | small


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ppo", "sac"])
def test_algorithms_train_with_conditions(kind, bank):
    values = TINY | {
        "task": TINY["task"] | YAML,
        "algorithm": algorithm(kind),
        "traffic": "log",
        "start": "log_start",
    }
    config = settings.load(TrainConfig, values)
    learner = config.algorithm.build(config.environment(LogTraffic()), bank, 2)
    state, logs = learner.init(bank, jax.random.key(0)), {}
    iterate = jax.jit(learner.iterate)
    for _ in range(2):
        state, logs = iterate(bank, state)
    assert all(np.isfinite(value).all() for value in jax.tree.leaves(logs))
    if kind == "sac":
        stored = state.replay.stored.conditions
        assert stored.shape[-1] == 2 and len(np.unique(np.asarray(stored))) > 2


@pytest.mark.slow
def test_policies_export_and_evaluate_with_other_numbers(tmp_path, bank):
    run = write_run(tmp_path / "run", bank, **YAML)
    export_policy(run.path, tmp_path / "policy", bank)
    planner, task = load_policy(tmp_path / "policy", bank)
    assert [condition.name for condition in task.conditions] == ["collision", "desired_speed"]
    assert hash(task) == hash(load_policy(run.path, bank)[1])
    names = [{"dataset": "d", "scenario_id": str(i), "segment": str(i)} for i in range(2)]
    fixed = (fix_conditions(task.conditions, {"desired_speed": factor}) for factor in (0.7, 1.2))
    slow, fast = (evaluate(planner, bank, names, task=replace(task, conditions=each)) for each in fixed)
    assert (slow.metrics["progress"] != fast.metrics["progress"]).all()


@pytest.mark.slow
def test_command_line_changes_the_numbers_of_a_policy(tmp_path, capsys):
    data = generate(tmp_path / "set", 2, 21, Generation(workers=0)).path
    run = write_run(tmp_path / "run", load(data).bank, **YAML)
    command = ["evaluate", "--planner", str(run.path), "--data", str(data), "--out", str(tmp_path / "out")]
    assert cli.main([*command, "--condition", "desired_speed=0.7"]) == 0
    written = settings.load(EvaluationConfig, tmp_path / "out" / "config.yaml").task.conditions
    assert {condition.name: condition.value for condition in written} == {
        "collision": 1.0,
        "desired_speed": 0.7,
    }
    assert cli.main([*command, "--overwrite", "--condition", "desired_sped=0.7"]) == 2
    assert "no condition 'desired_sped'" in capsys.readouterr().err


WRONG = [
    ({"name": "collison", "low": 0.5, "high": 2}, "not in the reward; did you mean 'collision'"),
    ({"name": "ttc", "low": 0.5, "high": 2}, "ttc: not in the reward; give ttc a weight"),
    ({"name": "ttc_s", "low": 0.5, "high": 2}, "ttc_s: not in the reward; give ttc a weight"),
    ({"name": "desired_speed", "low": 0.5, "high": 3}, "use at most 2"),
    ({"name": "collision", "low": 2, "high": 0.5}, "0 <= low < high"),
    ({"name": "collision", "low": 2, "high": 3}, "value 1.0 is not in 2.0 to 3.0"),
    ({"name": "collision", "high": 3}, "low"),
    ({"name": "collision_margin_m", "low": 0, "high": 1}, "collision_margin_m: not in the reward"),
]


@pytest.mark.parametrize(("condition", "message"), WRONG)
def test_wrong_conditions_are_refused(condition, message):
    task = {"rewards": YAML["rewards"], "conditions": [condition]}
    with pytest.raises(UsageError, match=message):
        settings.load(TrainConfig, {"task": task})


def test_conditions_are_unique():
    with pytest.raises(UsageError, match="occurs twice"):
        check_conditions((COLLISION, COLLISION), REWARDS)
    group = OwnGroup(lambda bank, context, frames: jnp.zeros(1), name="conditions")
    with pytest.raises(ValueError, match="'conditions' is taken"):
        replace(TASK, observation=replace(GLIMPSE, own=(group,)))
    with pytest.raises(UsageError, match=r"value 0\.5 is not in"):
        fix_conditions(CONDITIONS, {"desired_speed": 0.5})
    with pytest.raises(UsageError, match="condition ttc_s occurs twice"):
        parse_values(["ttc_s=1", "ttc_s=2"])
    with pytest.raises(UsageError, match="this planner has no conditions"):
        fix_conditions((), {"desired_speed": 0.5})


def test_configuration_and_command_line():
    flag = "[{name: desired_speed, low: 0.7, high: 1.2}]"
    overrides = ["--task.rewards.excess_speed", "-0.5", "--task.conditions", flag]
    config = settings.load(TrainConfig, {}, overrides)
    assert config.task.conditions == (SPEED,)
    assert settings.load(TrainConfig, settings.parse_yaml(settings.dump(config))) == config
