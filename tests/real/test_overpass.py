"""The overpass of the ScenarioNet sample: two levels of road cross, and only one of them is there for a car."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.datasets.formats import detect
from drivax.evaluation.audit import audit
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import windows, with_ego
from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.task import Task

FILE = "scenarionet/sd_waymo_v1.2_eb4b91b10ca94ff2.pkl"


def flattened(recording):
    """The same world with everything at one height."""
    features = tuple(
        replace(f, points=np.concatenate([f.points[:, :2], 0 * f.points[:, :1]], 1))
        for f in recording.features
    )
    lights = tuple(replace(li, stop_point=li.stop_point * [1, 1, 0]) for li in recording.lights)
    tracks = replace(recording.tracks, z=0 * recording.tracks.z)
    return replace(recording, features=features, lights=lights, tracks=tracks)


def moving(recording):
    """Rows of vehicles that are seen for the next 2 s and drive at least 2 m meanwhile."""
    now, tracks = recording.current_step, recording.tracks
    way = np.hypot(*(tracks.xy[:, now + 20] - tracks.xy[:, now]).T)
    seen = tracks.valid[:, now : now + 21].all(axis=1)
    return np.flatnonzero(seen & (tracks.kind == AgentKind.VEHICLE) & (way > 2.0))


@pytest.fixture(scope="module")
def driven(real_data):
    """Windows of the recording, each with a vehicle of it that moves."""
    (recording,) = detect(real_data / FILE).read(real_data / FILE)
    return [(window, int(row)) for window in windows(recording) for row in moving(window)]


@pytest.mark.slow
def test_levels_are_separated_by_height(driven):
    real = audit([assemble(with_ego(window, row)) for window, row in driven])
    flat = audit([assemble(with_ego(flattened(window), row)) for window, row in driven])
    assert len(real) >= 20 and not any(finding["log_collides"] for finding in real)
    off_real, off_flat = (sum(f["log_offroad_fraction"] for f in found) for found in (real, flat))
    assert off_real < 0.01 * len(real) and off_flat > off_real, (off_real, off_flat)


@pytest.mark.slow
def test_vehicle_height_follows_its_road(driven):
    """Looked up in the map step by step, the height of every replayed car stays with the logged one."""
    bank = ScenarioBank.from_scenarios([assemble(with_ego(window, row)) for window, row in driven])
    simulator = Simulator(Task(metrics="none", ends=()))

    def one(state, _):
        action = jnp.zeros(2)
        state, _ = simulator.replay(bank, state, logged_motion(bank, state.context, 1), action)
        return state, state.context.z

    @jax.jit
    @jax.vmap
    def heights(index):
        return jax.lax.scan(one, simulator.reset(bank, index), None, 80)[1]

    found, logged = (
        np.asarray(heights(jnp.arange(len(driven)))),
        np.asarray(bank.agents[:, 11:, 0, AgentColumn.Z]),
    )
    there = np.asarray(bank.agents[:, 11:, 0, AgentColumn.VALID]) > 0
    apart = np.abs(found - logged)[there]
    # Recorded boxes float by centimetres over the road that was recorded with them.
    assert np.quantile(apart, 0.99) < 0.5 and np.median(apart) < 0.1
