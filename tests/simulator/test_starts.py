"""Starts: at any step of the log, and after a second of perturbed driving."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.api import evaluate
from drivax.api import load as load_scenarios
from drivax.errors import UsageError
from drivax.geometry.boxes import corners, overlap
from drivax.learning.config import TrainConfig
from drivax.planners.simple import ConstantVelocity, Expert
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.build.assemble import assemble
from drivax.settings import dump, load, parse_yaml
from drivax.simulator.contact import Contact
from drivax.simulator.dynamics import GRIP_MPS2, command_between
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, NoisyStart
from drivax.simulator.traffic.override import OverrideTraffic, with_override
from drivax.simulator.types import HISTORY
from drivax.tasks.task import Task
from scenes import LANE_M, SMALL, bank_of, car, straight_road

NOISY = Simulator(Task(), start=NoisyStart())


@jax.jit
def noisy(bank, step, keys):
    """Starts of one scenario, one per key."""
    return jax.vmap(lambda key: NOISY.context(bank, 0, step, 0, key))(keys)


@jax.jit
def draw_at(speed, keys):
    return jax.vmap(lambda key: NoisyStart().draw(key, speed))(keys)


def keys(count, seed=0):
    return jax.random.split(jax.random.key(seed), count)


@pytest.fixture(scope="module")
def open_road():
    return bank_of(straight_road([car(0, 0.9, 0, 6)]))


@pytest.mark.parametrize("speed", [0.0, 5.0, 30.0])
def test_draws_are_distributed_as_published(speed):
    draws = draw_at(jnp.float32(speed), keys(20_000))
    acceleration, curvature = (np.asarray(part, np.float64) for part in draws)
    bound = 0.3 * (0.4 - 0.37 * min(speed / (40 / 3.6), 1.0))
    strong = (acceleration >= 6 * 0.54) & (np.abs(curvature) >= 0.9 * bound)
    # Mild draws end among the strong ones by chance: with probability 0.1 in either quantity.
    assert strong.mean() == pytest.approx(0.75 + 0.25 * 0.01, abs=0.015)
    # Uniform on [0.54, 0.6] and on [0, 0.6]: means 0.57 and 0.3, variances 0.06^2 / 12 and 0.6^2 / 12.
    mean = 0.75 * 0.57 + 0.25 * 0.3
    spread = 0.75 * (0.06**2 / 12 + 0.57**2) + 0.25 * (0.6**2 / 12 + 0.3**2) - mean**2
    assert acceleration.mean() == pytest.approx(6 * mean, abs=0.03)
    assert acceleration.std() == pytest.approx(6 * spread**0.5, rel=0.03)
    # Left and right alike; the size is uniform on [0.9, 1] or [0, 1] of the bound.
    square = 0.75 * (0.1**2 / 12 + 0.95**2) + 0.25 / 3
    assert curvature.mean() == pytest.approx(0.0, abs=0.03 * bound)
    assert curvature.std() == pytest.approx(bound * square**0.5, rel=0.03)
    assert acceleration.min() >= 0.0 and acceleration.max() <= 3.6 and np.abs(curvature).max() <= bound


@pytest.mark.slow
def test_perturbed_history_uses_one_action(open_road):
    contexts = noisy(open_road, 10, keys(64))
    history = contexts.history
    logged = LogStart().begin(open_road, jnp.int32(0), jnp.int32(0), jnp.int32(0), None)[0]
    np.testing.assert_allclose(history[:, :-10], np.broadcast_to(logged[-13:], (64, 13, 4)), atol=1e-4)
    between = jax.vmap(jax.vmap(command_between))(history[:, -11:-1], history[:, -10:])
    acceleration, curvature = map(np.asarray, between)
    assert np.ptp(acceleration, axis=1).max() < 1e-2 and (acceleration >= -1e-3).all()
    grip = GRIP_MPS2 / np.asarray(history[:, -11:-1, 3]) ** 2
    free = (np.abs(curvature) < 0.95 * grip).all(axis=1)
    assert free.sum() > 32 and np.ptp(curvature[free], axis=1).max() < 1e-3
    # All are at step 10 of the log, at most 0.3 m behind the logged position (some turn), and differ.
    assert (np.asarray(contexts.step) == 10).all()
    assert (history[:, -1, 0] >= -0.3).all() and len(np.unique(np.asarray(history[:, -1, 1]))) > 48
    travelled = np.asarray(contexts.route_m - open_road.log_progress[0, 0])
    np.testing.assert_allclose(travelled, np.asarray(history[:, -1, 0] - logged[-1, 0]), atol=0.3)


def test_no_start_collides_or_is_off_the_road():
    # Lane 1 between the right edge and a column in lane 2: many draws end in either.
    column = [car(x, 3.4, 0, 6) for x in range(-24, 25, 6)]
    bank = bank_of(straight_road([car(0, 0.0, 0, 6), *column]))
    x, y, heading, _ = np.asarray(noisy(bank, 10, keys(64)).history[:, -1]).T
    rest = np.tile([4.8, 2.0], (64, 1))
    box = np.concatenate([np.stack([x, y, np.cos(heading), np.sin(heading)], -1), rest], -1)
    assert corners(box)[..., 1].min() >= -LANE_M / 2 - 0.3
    others = np.array([[x, 3.4, 1, 0, 4.8, 2.0] for x in range(-24, 25, 6)])
    assert not overlap(box[:, None], others).any()
    assert np.ptp(y) > 0.2, "some draws are kept"


def test_episode_starts_as_logged_when_every_draw_fails():
    # Ego is 0.5 m behind a car, and 0.1 m to the right of a column of cars.
    column = [car(x, 2.1, 0, 6) for x in (-6, 0, 6)]
    bank = bank_of(straight_road([car(0, 0, 0, 6), car(5.3, 0, 0, 6), *column]))
    strong = Simulator(Task(), start=NoisyStart(strong=1.0))
    logged = Simulator(Task()).context(bank, 0, 10)
    drawn = jax.jit(jax.vmap(lambda key: strong.context(bank, 0, 10, 0, key)))(keys(16))
    np.testing.assert_array_equal(drawn.history, np.broadcast_to(logged.history, drawn.history.shape))
    np.testing.assert_array_equal(drawn.route_m, np.full(16, logged.route_m))


@pytest.mark.slow
def test_noisy_start_does_not_collide_with_overridden_agents():
    # In the log no agent is near; the other car is overridden to stand where some draws would lead.
    bank = bank_of(straight_road([car(0, 0.9, 0, 6), car(80, 0.9, 0, 6)]))
    motion = jnp.tile(jnp.asarray([5.3, 2.4, 0.0, 0.0]), (1, bank.steps, 1, 1))
    overridden = with_override(bank, jnp.asarray([[1]]), motion)
    simulator = Simulator(Task(metrics=("collision",)), OverrideTraffic(), NoisyStart(tries=16))
    state = jax.jit(jax.vmap(lambda key: simulator.reset(overridden, 0, 10, 0, key)))(keys(256))
    # An agent that overlaps ego at the start would be ignored.
    assert not (np.asarray(state.contacts) == Contact.IGNORED).any()
    alone = [noisy(bank, 10, part).history for part in keys(256).reshape(4, 64)]
    beside = np.concatenate(alone)[:, -1]
    near = (np.abs(beside[:, 0] - 5.3) < 4.8) & (np.abs(beside[:, 1] - 2.4) < 2.0)
    assert near.any(), "some draws would have touched"


def test_perturbs_fewer_steps_where_the_log_starts_later(open_road):
    first = Simulator(Task()).context(open_road, 0, 0)
    for step, driven in ((0, 0), (3, 3)):
        history = np.asarray(noisy(open_road, step, keys(64)).history)
        old = np.asarray(first.history)[driven:]
        np.testing.assert_allclose(
            history[:, : HISTORY - driven], np.broadcast_to(old, (64, *old.shape)), atol=1e-4
        )
    late = bank_of(straight_road([car(0, 0.9, 0, 6, steps=range(6, 91))]))
    history = np.asarray(noisy(late, 10, keys(64)).history)
    assert np.ptp(history[:, 18], axis=0).max() < 1e-4, "the agent is unknown before step 6"
    assert np.ptp(history[:, 19:, 1], axis=0).max() > 1e-4


def test_a_start_depends_on_its_key_only(open_road):
    drawn = keys(64)
    many, again = noisy(open_road, 10, drawn), noisy(open_road, 10, drawn[::-1])
    np.testing.assert_array_equal(many.history, again.history[::-1])


def test_a_noisy_start_without_a_key_is_refused(open_road):
    with pytest.raises(UsageError, match="needs a random key"):
        NOISY.reset(open_road, 0)


@pytest.mark.parametrize(
    "options", [{"steps": HISTORY}, {"steps": 0}, {"strong": 1.5}, {"scale": np.inf}, {"tries": 0}]
)
def test_invalid_settings_are_refused(options):
    with pytest.raises(UsageError):
        NoisyStart(**options)


def test_episode_starts_at_any_step_as_logged():
    bank = bank_of(straight_road([car(0, 0, 0, 6), car(30, 3.7, 0, 4)]))
    simulator = Simulator(Task(metrics=("ade", "progress"), ends=()))
    states = jax.jit(jax.vmap(lambda step: simulator.reset(bank, 0, step)))(jnp.arange(90))
    row = bank.agents[0, :90, 0]
    logged = jnp.stack(
        [row[:, 0], row[:, 1], jnp.arctan2(row[:, AgentColumn.SIN], row[:, AgentColumn.COS])], -1
    )
    np.testing.assert_allclose(states.context.history[:, -1, :3], logged, atol=1e-6)
    np.testing.assert_allclose(states.facts.log_divergence_m, 0.0, atol=1e-6)
    np.testing.assert_allclose(np.diff(states.facts.progress_m), 0.6, atol=1e-2)
    assert (np.asarray(states.start) == np.arange(90)).all()


def test_training_accepts_noisy_starts():
    config = load(TrainConfig, {"start": {"kind": "noisy_start", "scale": 0.5}})
    assert config.start == NoisyStart(scale=0.5) and load(TrainConfig, {}).start == LogStart()
    assert load(TrainConfig, parse_yaml(dump(config))) == config


@pytest.mark.slow
def test_evaluation_starts_and_counts_from_the_noisy_start():
    """80 steps at the speed and heading that the noise left: nothing of the second before is in any metric."""
    data = load_scenarios([assemble(straight_road([car(0, 1.8, 0, 2)]), SMALL)])
    same, other = (
        evaluate(ConstantVelocity(), data, start=NoisyStart(), seed=seed, task=Task(metrics=("distance",)))
        for seed in (3, 4)
    )
    for found in (same, other):
        motion = found.trajectories.ego[0]
        assert len(motion) == 81 and motion[0, 3] > 2.0
        assert found.metrics["distance"][0] == pytest.approx(8.0 * motion[0, 3], rel=1e-3)
        assert 0.0 <= found.metrics["progress_ratio"][0] <= 1.0
    assert same.trajectories.ego[0, 0, 3] != other.trajectories.ego[0, 0, 3]
    with pytest.raises(UsageError, match="cannot start elsewhere"):
        evaluate(Expert(), data, start=NoisyStart())
