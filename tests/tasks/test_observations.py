"""Observations: layout, masks, frame, invariances."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import PRESETS, ObservationConfig, running_count
from drivax.tasks.task import Task
from drivax.testing.worlds import rotate_recording
from scenes import RED, bank_of, car, straight_road


@partial(jax.jit, static_argnums=1)
def _look(bank, config):
    simulator = Simulator(Task(observation=config))
    return simulator.observe(bank, simulator.context(bank, 0, 10))


def look(bank, preset="optimal"):
    return _look(bank, PRESETS[preset])


@pytest.mark.parametrize("preset", ["maximal", "minimal", "optimal", "standard"])
def test_presets_have_the_declared_groups_and_shapes(preset):
    config = PRESETS[preset]
    obs = look(bank_of(straight_road([car(0, 0, 0, 9), car(20, 0, 0, 5)], light=RED)), preset)
    shapes = {name: value.shape for name, value in obs.items()}
    assert shapes == {
        "ego": (config.steps, 6),
        "ego_static": (4,),
        "agents": (config.agents, config.steps, 12),
        "agents_mask": (config.agents, config.steps),
        "road": (config.road, 10),
        "road_mask": (config.road,),
        "lights": (config.lights, 7),
        "lights_mask": (config.lights,),
        "route": (config.route, 5),
        "route_mask": (config.route,),
    }
    for name in ("agents", "road", "lights", "route"):
        value, mask = np.asarray(obs[name]), np.asarray(obs[f"{name}_mask"])
        assert mask.any() and (value[~mask] == 0).all() and np.abs(value).max() <= 3.0


def test_values_of_a_known_scene():
    cars = [car(0, 0, 0, 9), car(20, 1.0, np.pi / 2, 6), car(-10, 3.7, 0, 3, 0.6, 0.6, AgentKind.PEDESTRIAN)]
    obs = look(bank_of(straight_road(cars, light=RED)))
    ego, agents = np.asarray(obs["ego"]), np.asarray(obs["agents"])
    # The last row is now: at the origin, straight ahead, 9 m/s; four steps ago ego was 3.6 m behind.
    np.testing.assert_allclose(ego[-1], [0, 0, 0, 1, 9 / 15, 0], atol=1e-5)
    np.testing.assert_allclose(ego[0, :2], [-3.6 / 50, 0], atol=1e-5)
    # Nearest first: the pedestrian at 10.7 m, then the crossing car at 20.0 m.
    np.testing.assert_allclose(agents[0, -1, :2], [-10 / 50, 3.7 / 50], atol=1e-5)
    np.testing.assert_allclose(agents[0, -1, 8:], [0, 1, 0, 0])
    np.testing.assert_allclose(agents[1, -1, 2:8], [1, 0, 0, 6 / 15, 4.8 / 5, 2.0 / 5], atol=1e-5)
    assert np.asarray(obs["agents_mask"]).sum() == 10
    lights = np.asarray(obs["lights"])
    np.testing.assert_allclose(lights[0], [40 / 50, 0, 0, 0, 0, 1, 1], atol=1e-4)
    route = np.asarray(obs["route"])
    np.testing.assert_allclose(route[:, 0], np.arange(1, 11) * 5 / 50, atol=1e-3)
    np.testing.assert_allclose(route[:, 2:], np.tile([0, 1, 13.4 / 15], (10, 1)), atol=1e-4)


def test_velocity_keeps_its_sign():
    obs = look(bank_of(straight_road([car(0, 0, 0, 5), car(30, 3.7, np.pi, 10)])))
    np.testing.assert_allclose(np.asarray(obs["agents"])[0, -1, 4:6], [-10 / 15, 0], atol=1e-5)


def test_road_rows_lie_in_the_box_and_are_cut_by_rank():
    bank = bank_of(straight_road([car(0, 0, 0, 5)]))
    many, short = look(bank), _look(bank, ObservationConfig(road=6))
    rows = np.asarray(many["road"])[np.asarray(many["road_mask"])] * 50
    assert (rows[:, 0] > -10.1).all() and (rows[:, 0] < 70.1).all() and (np.abs(rows[:, 1]) < 25.1).all()
    np.testing.assert_array_equal(np.asarray(short["road"]), np.asarray(many["road"])[:6])
    edges = np.asarray(many["road"])[np.asarray(many["road_mask"])][:, 6]
    assert edges.sum() > 0 and np.asarray(look(bank, "standard")["road"])[:, 6].sum() == 0


def test_rotation_and_shift_change_nothing():
    recording = straight_road([car(0, 0, 0, 9), car(20, 1, 0.3, 6), car(-7, 3.7, 0, 8)], light=RED)
    one, other = (look(bank_of(r)) for r in (recording, rotate_recording(recording, 1.3, 500.0, -900.0)))
    for name in one:
        if name.startswith("road"):
            continue  # the order of rank may differ where two pieces are equally near; compared as sets below
        np.testing.assert_allclose(one[name], other[name], atol=2e-3, err_msg=name)
    rows = [np.asarray(obs["road"])[np.asarray(obs["road_mask"])] for obs in (one, other)]
    assert rows[0].shape == rows[1].shape
    ordered = [r[np.lexsort(np.round(r[:, :2], 2).T)] for r in rows]
    np.testing.assert_allclose(ordered[0][:, :2], ordered[1][:, :2], atol=5e-3)


def test_observation_is_finite_without_other_agents():
    obs = look(bank_of(straight_road([car(0, 0, 0, 0)])), "maximal")
    assert all(bool(jnp.isfinite(value).all()) for value in jax.tree.leaves(obs))
    assert not np.asarray(obs["agents_mask"]).any()


def test_groups_may_have_no_rows():
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(20, 1, 0.3, 6)], light=RED))
    config = ObservationConfig(agents=0, steps=2, road=0, lights=0, route=0)
    simulator = Simulator(Task(observation=config))
    obs = jax.jit(lambda b: simulator.observe(b, simulator.context(b, 0, 10)))(bank)
    shapes = {name: value.shape for name, value in obs.items()}
    assert shapes == {
        "ego": (2, 6), "ego_static": (4,), "agents": (0, 2, 12), "agents_mask": (0, 2), "lights": (0, 7),
        "lights_mask": (0,), "route": (0, 5), "route_mask": (0,),
    }  # fmt: skip


def test_replayed_observation_equals_live_observation():
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(20, 1, 0.3, 6)]))
    simulator = Simulator(Task(metrics="none"))
    state = jax.jit(simulator.reset)(bank, 0)
    step, observe = jax.jit(simulator.step), jax.jit(simulator.observe)
    for _ in range(5):
        state, transition = step(bank, state, jnp.array([0.1, 0.02]))
        live = observe(bank, state.context)
        stored = jax.tree.map(np.asarray, transition.after.context)
        again = observe(bank, jax.tree.map(jnp.asarray, stored))
        jax.tree.map(np.testing.assert_array_equal, dict(live), dict(again))


@pytest.mark.parametrize("count", [1, 7, 8, 9, 468, 1024])
def test_running_count_is_a_cumulative_sum(count):
    inside = np.random.default_rng(count).random((3, count)) < 0.3
    np.testing.assert_array_equal(jax.jit(jax.vmap(running_count))(inside), np.cumsum(inside, axis=1))
