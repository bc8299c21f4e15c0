from __future__ import annotations

import numpy as np
import pytest

from drivax.scenario.schema import LightState
from drivax.synthetic.roads.families import SignalisedJunction
from drivax.synthetic.roads.signals import (
    Colour,
    LightGroup,
    SignalPlan,
    combine_plans,
    light_states,
    yellow_time_s,
)

PLAN = SignalPlan(
    groups=(LightGroup((0,), True), LightGroup((1, 2), False)),
    phases=((0,), (1,)),
    green_s=(5.0, 8.0),
    yellow_s=3.0,
    all_red_s=1.5,
    offset_s=2.0,
)


def test_colours_follow_the_phases_of_the_cycle():
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


def test_light_states_of_arrows_and_round_lights():
    colours = np.array([Colour.NONE, Colour.GREEN, Colour.YELLOW, Colour.RED], np.int8)
    assert light_states(colours, True).tolist() == [
        -1,
        LightState.ARROW_GO,
        LightState.ARROW_CAUTION,
        LightState.ARROW_STOP,
    ]
    assert light_states(colours, False).tolist() == [-1, LightState.GO, LightState.CAUTION, LightState.STOP]


def test_phase_of_a_lane_serves_it_or_raises():
    assert [PLAN.phase_of(lane) for lane in range(3)] == [0, 1, 1]
    with pytest.raises(KeyError):
        PLAN.phase_of(3)


def test_yellow_time_follows_the_ite_formula():
    # 17.9 m/s: one second, then 17.9 / (2 x 3.05) s of braking to a stop or of driving through.
    assert yellow_time_s(17.9) == pytest.approx(3.934, abs=1e-3)
    assert yellow_time_s(8.3) == 3.0


def test_combined_plans_keep_their_own_cycles():
    second = SignalPlan((LightGroup((4, 5), False), LightGroup((6,), False)), ((0,), (1,)), (4.0, 6.0))
    both = combine_plans(PLAN, second, 1.0)
    assert both.cycle_s == 22.0
    assert both.starts_s == (0.0, 9.5, 1.0, 9.5)
    assert [both.phase_of(lane) for lane in (0, 2, 5, 6)] == [0, 1, 2, 3]
    times = np.arange(0.0, 100.0, 0.1)
    colour, left = both.colours(times, 8)
    alone, _ = PLAN.colours(times, 8)
    assert np.array_equal(colour[:, :4], alone[:, :4])
    # The second one's cycle is 4 + 6 + 2 x 4.5 = 19 s, its green begins at 2 + 1 s.
    for k, shown in ((3.05, Colour.GREEN), (6.85, Colour.GREEN), (7.05, Colour.YELLOW), (10.05, Colour.RED)):
        at = int(np.searchsorted(times, k))
        assert colour[at, 4] == colour[at + 190, 4] == colour[at + 380, 5] == shown
    assert left[72, 4] == pytest.approx(2.8, abs=1e-4)


def test_stretching_a_cycle_lengthens_the_first_green():
    longer = PLAN.stretch(30.0)
    assert longer.cycle_s == 30.0
    assert longer.green_s == (13.0, 8.0)


def test_all_lights_are_red_between_phases():
    network = SignalisedJunction().build(np.random.default_rng(3))
    plan = network.signals
    times = np.arange(0.0, plan.cycle_s, 0.05)
    colour, _ = plan.colours(times, len(network.lanes))
    connectors = [i for i, lane in enumerate(network.lanes) if lane.connector]
    all_red = np.all(colour[:, connectors] == Colour.RED, axis=1)
    assert 1.0 <= plan.all_red_s <= 2.0
    assert all_red.sum() * 0.05 == pytest.approx(plan.all_red_s * len(plan.phases), abs=0.4)
