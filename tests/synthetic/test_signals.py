from __future__ import annotations

import itertools

import numpy as np
import pytest

from drivax.scenario.schema import LightState
from drivax.synthetic.families import SignalisedJunction
from drivax.synthetic.signals import Colour, LightGroup, SignalPlan, light_states

PLAN = SignalPlan(
    groups=(LightGroup((0,), True), LightGroup((1, 2), False)),
    phases=((0,), (1,)),
    green_s=(5.0, 8.0),
    yellow_s=3.0,
    all_red_s=1.5,
    offset_s=2.0,
)


def test_a_cycle_by_hand():
    assert PLAN.cycle_s == 22.0
    assert PLAN.starts_s == (0.0, 9.5)
    times = np.array([1.9, 2.0, 6.9, 7.0, 9.9, 10.0, 11.4, 11.5, 19.4, 19.5, 22.4, 22.5, 23.9, 24.0])
    colour, left = PLAN.colours(times, 4)
    g, y, r = Colour.GREEN, Colour.YELLOW, Colour.RED
    assert colour[:, 0].tolist() == [r, g, g, y, y, r, r, r, r, r, r, r, r, g]
    assert colour[:, 1].tolist() == [r, r, r, r, r, r, r, g, g, y, y, r, r, r]
    assert np.array_equal(colour[:, 1], colour[:, 2])
    assert not colour[:, 3].any()
    assert left[3:5, 0] == pytest.approx([3.0, 0.1], abs=1e-5)
    assert left[5:, 0] == pytest.approx(0.0)


def test_states_of_arrows_and_round_lamps():
    colours = np.array([Colour.NONE, Colour.GREEN, Colour.YELLOW, Colour.RED], np.int8)
    assert light_states(colours, True).tolist() == [
        -1,
        LightState.ARROW_GO,
        LightState.ARROW_CAUTION,
        LightState.ARROW_STOP,
    ]
    assert light_states(colours, False).tolist() == [-1, LightState.GO, LightState.CAUTION, LightState.STOP]


def test_the_phase_of_a_lane():
    assert [PLAN.phase_of(lane) for lane in range(3)] == [0, 1, 1]
    with pytest.raises(KeyError):
        PLAN.phase_of(3)


@pytest.mark.parametrize("seed", range(12))
def test_conflicting_movements_never_go_together(seed):
    """Boxes 1.9 m wide and 4.7 m long cannot touch anywhere on two ways that show green or yellow together."""
    network = SignalisedJunction().build(np.random.default_rng(seed))
    times = np.arange(0.0, network.signals.cycle_s, 0.1)
    colour, _ = network.signals.colours(times, len(network.lanes))
    go = (colour == Colour.GREEN) | (colour == Colour.YELLOW)
    ways = [i for i, lane in enumerate(network.lanes) if lane.connector]
    served = colour[:, ways] == Colour.GREEN
    assert served.any(axis=0).all()  # everybody gets green once per cycle
    assert (colour[:, ways] == Colour.RED).any(axis=0).all()
    for a, b in itertools.combinations(ways, 2):
        if network.lanes[a].predecessors == network.lanes[b].predecessors or not (go[:, a] & go[:, b]).any():
            continue
        one, other = network.lanes[a].curve.xy, network.lanes[b].curve.xy
        near = np.sqrt(np.min(np.sum((one[:, None] - other[None]) ** 2, axis=-1)))
        assert near > 2.8
        assert network.lanes[a].successors != network.lanes[b].successors


def test_between_phases_everybody_has_red():
    network = SignalisedJunction().build(np.random.default_rng(3))
    plan = network.signals
    times = np.arange(0.0, plan.cycle_s, 0.05)
    colour, _ = plan.colours(times, len(network.lanes))
    ways = [i for i, lane in enumerate(network.lanes) if lane.connector]
    all_red = np.all(colour[:, ways] == Colour.RED, axis=1)
    assert 1.0 <= plan.all_red_s <= 2.0
    assert all_red.sum() * 0.05 == pytest.approx(plan.all_red_s * len(plan.phases), abs=0.4)
