"""Reactive traffic in random scenes of the built-in world, against an oracle (``tests/traffic_oracle.py``)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.geometry.boxes import overlap
from drivax.planners.simple import ConstantVelocity
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.simulator.traffic.agent_paths import AgentPaths
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.reactive import DRIVES, WAITS
from drivax.synthetic.world import generate_recording
from traffic_oracle import SIMULATOR, TRAFFIC, Path, compare, new_overlaps, rolled, runs_of

pytestmark = pytest.mark.slow


def world(count, seed=11):
    scenarios = [assemble(generate_recording(seed, i)) for i in range(count)]
    return TRAFFIC.prepare(ScenarioBank.from_scenarios(scenarios))


@pytest.fixture(scope="module")
def bank():
    return world(3)


@pytest.fixture(scope="module")
def runs(bank):
    return runs_of(bank)


def test_every_vehicle_follows_idm(bank, runs):
    found = np.concatenate([compare(bank, index, *run) for index, run in enumerate(runs)])
    away, acceleration = found.T
    assert len(found) > 300 and (acceleration < 0).sum() > 60
    # The oracle measures along all points of the path, the simulator along straight pieces: gaps differ by centimetres.
    assert np.quantile(away, 0.99) < 1e-3 and away.max() < 5e-3


def test_vehicles_stay_on_their_paths_and_never_enter_occupied_space(bank, runs):
    for index, (frames, traffic) in enumerate(runs):
        slots = np.asarray(data_of(bank, AgentPaths).slot[index])
        for row in np.flatnonzero((traffic.phase == DRIVES).any(0) & (slots > 0)):
            path, slot = Path(data_of(bank, AgentPaths), index, row), slots[row]
            there = np.flatnonzero(frames.valid[1:, slot]) + 1
            for t in there[::5]:
                assert path.project(frames.box[t, slot, :2].astype(np.float64), 0, np.inf)[1] < 0.01
            entered = np.flatnonzero((traffic.phase[:-1, row] == WAITS) & (traffic.phase[1:, row] == DRIVES))
            for t in entered:
                hits = overlap(frames.box[t + 1, slot], frames.box[t + 1]) & frames.valid[t + 1]
                hits &= np.abs(frames.z[t + 1] - frames.z[t + 1, slot]) <= 3
                hits[[slot, *traffic.ignored[t + 1, row]]] = False
                assert not hits.any()


def test_results_repeat_in_any_batch_order(bank):
    def speeds(rows):
        return np.asarray(rolled(bank, jnp.asarray(rows))[1].speed[:, :, -1])

    whole = speeds([0, 1, 2])
    np.testing.assert_array_equal(whole, speeds([0, 1, 2]))
    np.testing.assert_array_equal(whole[[1, 2, 0]], speeds([1, 2, 0]))


def test_state_fits_16_kib_with_128_reactive_agents(bank):
    state = jax.eval_shape(lambda b: SIMULATOR.reset(b, 0), bank)
    rows = data_of(bank, AgentPaths).slot.shape[1]
    whole, traffic = (
        sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(part))
        for part in (state, state.context.traffic)
    )
    # As if all 128 agents of the largest capacity reacted.
    assert whole - traffic + traffic / rows * 128 <= 16384


def test_reactive_pairs_rarely_overlap_in_the_built_in_world():
    bank = world(40, seed=7)
    found = [new_overlaps(bank, index, *run) for index, run in enumerate(runs_of(bank))]
    reacting = sum(len(agents) for _, agents in found)
    between = sum(len([pair for pair in pairs if set(pair) <= set(agents)]) for pairs, agents in found)
    print(
        f"{reacting} react, {sum(len(p) for p, _ in found)} new overlaps, {between} of them between two that react"
    )
    # Paths that cross or merge without a light: less than one vehicle in a hundred.
    assert reacting > 500 and between <= 0.01 * reacting


def test_results_do_not_depend_on_other_scenarios():
    scenarios = [assemble(generate_recording(9, i)) for i in range(3)]
    whole, part = (
        evaluate(ConstantVelocity(), ScenarioBank.from_scenarios(some), scenario_names(some), traffic=TRAFFIC)
        for some in (scenarios, scenarios[1:])
    )
    np.testing.assert_array_equal(whole.trajectories.ego[1:], part.trajectories.ego)
    for name, values in whole.metrics.items():
        np.testing.assert_array_equal(values[1:], part.metrics[name], err_msg=name)
    assert whole.traffic == "idm"
