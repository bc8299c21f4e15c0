"""Planners: what each promises, on scenes whose answer is known."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from drivax.api import find_planner
from drivax.errors import UsageError
from drivax.networks.actor_critic import NetworkConfig, Policy
from drivax.networks.encoders import MlpConfig
from drivax.planners.catalogue import PLANNERS, make_planner
from drivax.planners.functions import NetworkPlanner
from drivax.planners.planner import Memoryless, Planner, hold, limit_speed
from drivax.planners.simple import (
    ConstantSpeed,
    ConstantVelocity,
    Expert,
    IdmPlanner,
    RandomActions,
    expert_action,
    logged_motion,
    logged_poses,
)
from drivax.scenario.record import record, static
from drivax.simulator.ahead import follow_route
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.simulator import Simulator
from drivax.tasks.actions import PHYSICAL, ROUTE, DeltaLocal, Discrete, Trajectory, execute
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from quick import quick
from scenes import RED, bank_of, car, straight_road


@pytest.fixture(scope="module")
def simulator():
    seen = ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2)
    return Simulator(Task(observation=seen, metrics="none"))


@partial(jax.jit, static_argnums=0)
def first_moment(simulator, bank):
    """What every planner is given at step 10."""
    state = simulator.reset(bank, 0, 10, 0)
    return state, simulator.situation(bank, state), simulator.observe(bank, state.context)


@jax.jit
def first_action(planner, bank, state, situation, seen):
    key = jax.random.key(0)
    return planner.act(planner.init(bank, state, key), bank, state, situation, seen, key)[0]


def act(planner, simulator, bank):
    return np.asarray(first_action(planner, bank, *first_moment(simulator, bank)))


@jax.jit
def executed(bank, context, action):
    """The physical action of an action of the route space."""
    return execute(ROUTE, bank, context, action)


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_every_planner_returns_a_finite_action(name, simulator):
    planner = make_planner(name)
    assert isinstance(planner, Planner) and planner.name == name
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(30, 0, 0, 5)], light=RED))
    action = act(planner, simulator, bank)
    assert action.shape == (2,) and np.isfinite(action).all() and (np.abs(action) <= 1).all()
    # Leaves are arrays or nothing, settings are part of the structure: the same program serves equal planners.
    assert jax.tree.structure(planner) == jax.tree.structure(make_planner(name))


def test_idm_accelerates_by_its_law_on_a_free_road(simulator):
    # Desired speed is the limit of 13.4 m/s; a free road leaves a (1 - (v / v0)^4).
    action = act(IdmPlanner(), simulator, bank_of(straight_road([car(0, 0, 0, 9)])))
    assert action[0] * 6.0 == pytest.approx(1.5 * (1 - (9 / 13.4) ** 4), rel=1e-3)
    assert action[1] == pytest.approx(0.0, abs=1e-3)


def test_idm_brakes_for_the_nearest_agent_in_its_corridor(simulator):
    # Gap of 20 - 4.8 = 15.2 m to a car at 5 m/s.
    leader = act(IdmPlanner(), simulator, bank_of(straight_road([car(0, 0, 0, 9), car(20, 0, 0, 5)])))
    speed = np.array(9.0)
    expected = idm_acceleration(speed, np.array(13.4), np.array(15.2), np.array(5.0), IdmParameters())
    assert leader[0] * 6.0 == pytest.approx(float(expected), rel=1e-3)
    beside = act(IdmPlanner(), simulator, bank_of(straight_road([car(0, 0, 0, 9), car(20, 3.7, 0, 5)])))
    assert beside[0] > 0


def test_idm_law_by_hand():
    p = IdmParameters()
    # At rest, 2 m behind a standing leader: s* = s0 = gap, so a = a_max (1 - 0 - 1) = 0.
    assert float(idm_acceleration(np.array(0.0), np.array(10.0), np.array(2.0), np.array(0.0), p)) == 0.0
    # v = v0, free: zero; twice the comfortable gap of s0 + vT = 17 m: a (1 - 1 - 1/4).
    assert float(
        idm_acceleration(np.array(10.0), np.array(10.0), np.array(1e9), np.array(10.0), p)
    ) == pytest.approx(0)
    found = idm_acceleration(np.array(10.0), np.array(10.0), np.array(34.0), np.array(10.0), p)
    assert float(found) == pytest.approx(-1.5 / 4)
    # Never below the maximal deceleration.
    assert float(idm_acceleration(np.array(20.0), np.array(10.0), np.array(0.2), np.array(0.0), p)) == -6.0


def test_expert_follows_the_log_and_stays_where_it_ends(simulator):
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(20, 3.7, 0, 6, steps=range(60))]))
    ego = simulator.context(bank, 0, 88)
    np.testing.assert_allclose(logged_motion(bank, ego, 1), [71.1, 0, 0, 9], atol=1e-3)
    np.testing.assert_allclose(logged_motion(bank, ego, 4), [73.8, 0, 0, 9], atol=1e-3)
    gone = simulator.context(bank, 0, 59, 1)
    np.testing.assert_allclose(logged_motion(bank, gone, 1), gone.history[-1])
    steady = expert_action(bank, simulator.context(bank, 0, 10), PHYSICAL)
    np.testing.assert_allclose(steady, 0.0, atol=1e-4)


def test_logged_poses_go_on_through_gaps_and_after_the_log(simulator):
    late = car(20, 3.7, 0, 6, steps=[*range(30), *range(35, 60)])
    bank = bank_of(straight_road([car(0, 0, 0, 9), late]))
    time = np.arange(41)
    find = jax.jit(lambda bank, step, slot: logged_poses(bank, simulator.context(bank, 0, step, slot), 40))
    for slot, step, begin, speed in ((0, 70, 54.0, 9.0), (1, 28, 30.8, 6.0)):
        poses = find(bank, step, slot)
        np.testing.assert_allclose(poses[:, 0], begin + 0.1 * speed * time, atol=1e-3)
        np.testing.assert_allclose(poses[:, 1:], [[3.7 * slot, 0.0]] * 41, atol=1e-4)


@pytest.mark.parametrize("name", ["expert_actions", "idm", "pdm"])
def test_planners_plan_trajectories_for_a_controller(name):
    """From where ego is; behind a standing car the plans of IDM and PDM end before it, the log drives through."""
    space = Trajectory(steps=40)
    seen = ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2)
    tracked = Simulator(Task(actions=space, observation=seen, metrics="none"))
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(30, 0, 0, 0)]))
    plan = act(make_planner(name, space), tracked, bank).reshape(-1, 3)
    assert plan.shape == (41, 3)
    np.testing.assert_allclose(plan[0], 0.0, atol=1e-5)
    assert (np.diff(plan[:, 0]) > -1e-4).all() and np.abs(plan[:, 2]).max() < 0.1
    assert plan[-1, 0] == pytest.approx(36.0, abs=1e-3) if name == "expert_actions" else plan[-1, 0] < 25.2


@pytest.mark.slow
def test_a_network_acts_by_the_mode_or_by_a_sample(simulator):
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    observation = jax.eval_shape(lambda b: simulator.observe(b, simulator.context(b, 0, 10)), bank)
    spec = {name: value.shape for name, value in observation.items()}
    policy = Policy(NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(4,)), spec, nnx.Rngs(3))
    graph, weights = nnx.split(policy)
    mode, sample = (act(NetworkPlanner(weights, graph, samples=s), simulator, bank) for s in (False, True))
    _, _, seen = first_moment(simulator, bank)
    np.testing.assert_allclose(mode, policy(seen).mode(), rtol=1e-4, atol=1e-6)
    assert np.abs(sample - mode).max() > 1e-3 and (jnp.abs(sample) < 1).all()


def test_random_actions_fill_the_action_space_evenly_and_follow_the_key(simulator):
    planner, bank = RandomActions(), bank_of(straight_road([car(0, 0, 0, 9)]))
    state, situation, _ = first_moment(simulator, bank)
    keys = jax.random.split(jax.random.key(3), 4000)
    actions = quick(jax.vmap(lambda key: planner.act((), bank, state, situation, None, key)[0]), keys)
    # Uniform over [-1, 1): mean 0, variance 1/3, axes independent.
    assert np.abs(actions.mean(axis=0)).max() < 0.04
    assert actions.var(axis=0) == pytest.approx(1 / 3, rel=0.06)
    assert abs(np.corrcoef(actions.T)[0, 1]) < 0.05 and np.abs(actions).max() <= 1.0
    again = planner.act((), bank, state, situation, None, keys[7])[0]
    assert np.array_equal(np.asarray(again), actions[7])


def test_constant_speed_returns_to_the_route(simulator):
    """0.5 m left of a straight route, at a look-ahead of 0.8 v + 3 m; the acceleration is zero."""
    recording = straight_road([car(0, 0.5, 0, 9)])
    action = act(ConstantSpeed(), simulator, bank_of(recording))
    distance = 0.8 * 9 + 3
    assert action[0] == 0.0
    assert action[1] * 0.3 == pytest.approx(2 * -0.5 / (distance**2 + 0.25), rel=1e-3)


def test_constant_speed_is_the_zero_of_the_route_space(simulator):
    bank = bank_of(straight_road([car(0, 0.5, 0.1, 9)]))
    physical, route = (act(ConstantSpeed(space), simulator, bank) for space in (PHYSICAL, ROUTE))
    np.testing.assert_allclose(route, 0.0, atol=1e-5)
    state = first_moment(simulator, bank)[0]
    np.testing.assert_allclose(executed(bank, state.context, jnp.zeros(2)), physical, atol=1e-6)


def test_rule_planners_execute_the_same_in_the_route_space(simulator):
    """The offset that pursuit needs for a curvature is the inverse of the pursuit."""
    bank = bank_of(straight_road([car(0, 0.5, 0.1, 9), car(30, 0, 0, 5)]))
    state = first_moment(simulator, bank)[0]
    for planner in (IdmPlanner, ConstantVelocity, lambda actions: Expert(actions, replays=False)):
        physical, route = (act(planner(space), simulator, bank) for space in (PHYSICAL, ROUTE))
        assert abs(route[1]) < 1
        np.testing.assert_allclose(executed(bank, state.context, jnp.asarray(route)), physical, atol=1e-5)


def test_route_space_steers_straight_on_beyond_the_route_and_without_one(simulator):
    bank = bank_of(straight_road([car(0, 0, 0.1, 9)]))
    bank = replace(bank, on_lanes=jnp.zeros_like(bank.on_lanes))
    state = first_moment(simulator, bank)[0]
    assert float(follow_route(bank, state.context, jnp.zeros(()))) == pytest.approx(0.0, abs=1e-6)
    left = float(follow_route(bank, state.context, jnp.ones(())))
    assert left == pytest.approx(2 / (10.2**2 + 1), rel=1e-3)
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    context = first_moment(simulator, bank)[0].context
    end_m = float(bank.route_points[0] - 1)
    place = context.history.at[-1].set(jnp.array([end_m - float(context.route_m), 1.0, 0.0, 9.0]))
    beyond = replace(context, history=place, route_m=jnp.asarray(end_m))
    assert float(follow_route(bank, beyond, jnp.zeros(()))) == pytest.approx(-2 / (10.2**2 + 1), rel=1e-2)


@record
class Deciding(Memoryless):
    """Return one action, whatever happens."""

    decision: jax.Array
    name: str = static(default="deciding")

    def choose(self, bank, situation, observation, key):
        return self.decision


@pytest.mark.parametrize(
    ("decided", "executed"),
    [(0.8, 0.1), (0.05, 0.05), (-0.8, -0.8), (np.inf, 0.1), (-np.inf, -np.inf), (np.nan, np.nan)],
)
def test_limiter_bounds_the_acceleration_but_not_the_braking(decided, executed, simulator):
    """At 10 m/s, half of a limit of 21.2 m/s leaves 0.6 m/s: 0.6 m/s2 of 6."""
    road = straight_road([car(speed=10.0)], limit=21.2)
    planner = limit_speed(Deciding(jnp.array([decided, 0.25])), 0.5, PHYSICAL)
    assert PHYSICAL.acceleration_mps2 == 6.0
    np.testing.assert_allclose(act(planner, simulator, bank_of(road)), [executed, 0.25], rtol=1e-4)


def test_limiter_slows_down_gently_and_assumes_an_unknown_limit(simulator):
    """At 10 m/s, a tenth of 13.4 m/s asks for 8.7 m/s less within a second: by 2 m/s2 of 6."""
    bank = bank_of(straight_road([car(speed=10.0)], limit=-1.0))
    planner = limit_speed(Deciding(jnp.array([0.5, 0.0])), 0.1, PHYSICAL)
    assert PHYSICAL.braking_mps2 == 6.0 and planner.name == "deciding (limit x 0.1)"
    np.testing.assert_allclose(act(planner, simulator, bank), [-2.0 / 6.0, 0.0], rtol=1e-5)


def test_limiter_needs_accelerations_and_a_positive_share():
    assert limit_speed(IdmPlanner(), None, PHYSICAL) == IdmPlanner()
    with pytest.raises(UsageError, match="limited to -1 of the limit"):
        limit_speed(IdmPlanner(), -1.0, PHYSICAL)
    with pytest.raises(UsageError, match="replays the log"):
        limit_speed(Expert(), 0.5, PHYSICAL)
    for actions in (DeltaLocal(), Discrete()):
        with pytest.raises(UsageError, match="no continuous acceleration"):
            limit_speed(RandomActions(), 0.5, actions)


@pytest.mark.slow
def test_held_planner_decides_at_every_other_step(simulator):
    """Gaps shrink from step to step, so that IDM's decision changes at each."""
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(30, 0, 0, 5)]))
    planner, key, taken, fresh = hold(IdmPlanner(), 2), jax.random.key(0), [], []
    state = simulator.reset(bank, 0)
    carry = planner.init(bank, state, key)
    step = jax.jit(simulator.step)
    for _ in range(4):
        situation = simulator.situation(bank, state)
        action, carry = planner.act(carry, bank, state, situation, {}, key)
        taken.append(np.asarray(action))
        fresh.append(np.asarray(IdmPlanner().act((), bank, state, situation, {}, key)[0]))
        state = step(bank, state, action)[0]
    np.testing.assert_array_equal(taken[::2], fresh[::2])
    np.testing.assert_array_equal(taken[1::2], taken[::2])
    assert (np.asarray(fresh[1::2]) != np.asarray(taken[1::2])).any()
    assert hold(planner, 1) is planner and planner.name == "idm" and not planner.replays


def test_only_a_trained_policy_can_be_sampled():
    with pytest.raises(
        UsageError, match="'idm' is not a trained policy, so it cannot sample; leave out --sample"
    ):
        find_planner("idm", bank_of(straight_road([car()])), sample=True)
