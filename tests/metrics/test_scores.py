"""Scores: known values, and always in [0, 1]."""

import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.metrics.catalogue import nuplan_score, vmax_score
from drivax.metrics.steps import Value

PERFECT = {
    "ttc_ok": 1.0, "progress_ratio": 1.0, "speed_compliance": 1.0, "comfortable": 1.0, "lane_keeping": 1.0,
    "making_progress": 1.0, "direction": 1.0, "at_fault_collision": 0.0, "offroad": 0.0, "red_light": 0.0,
}  # fmt: skip


def values(undefined=(), **changes):
    return {
        name: Value(jnp.asarray(float(value)), jnp.asarray(name not in undefined))
        for name, value in (PERFECT | changes).items()
    }


def test_perfect_score_is_one_and_discomfort_costs_its_weight():
    for score in (nuplan_score, vmax_score):
        full, partial = score(values())
        assert float(full.value) == pytest.approx(1.0)
        assert bool(full.defined) and not bool(partial.defined)
    assert float(nuplan_score(values(comfortable=0.0))[0].value) == pytest.approx(0.875)
    assert float(vmax_score(values(comfortable=0.0))[0].value) == pytest.approx(17 / 19)


@pytest.mark.parametrize("gate", ["at_fault_collision", "offroad"])
def test_gates_of_both_scores(gate):
    for score in (nuplan_score, vmax_score):
        assert float(score(values(**{gate: 1.0}))[0].value) == 0.0


def test_red_light_gates_only_the_vmax_score():
    assert float(vmax_score(values(red_light=1.0))[0].value) == 0.0
    assert float(nuplan_score(values(red_light=1.0))[0].value) == pytest.approx(1.0)


def test_an_undefined_input_makes_the_score_partial():
    full, partial = vmax_score(values(undefined=("red_light",)))
    assert not bool(full.defined) and bool(partial.defined)
    assert float(partial.value) == pytest.approx(1.0)
    # Without the undefined term the weights are 5, 5 and 2, of which comfort has 2.
    _, partial = nuplan_score(values(undefined=("speed_compliance",), comfortable=0.0))
    assert float(partial.value) == pytest.approx(10 / 12)


@given(st.lists(st.floats(-2, 3), min_size=len(PERFECT), max_size=len(PERFECT)))
def test_scores_stay_in_the_unit_interval(numbers):
    raw = dict(zip(PERFECT, numbers, strict=True))
    gates = {
        name: min(max(round(raw[name]), 0), 1) for name in ("at_fault_collision", "offroad", "red_light")
    }
    gates |= {name: min(max(round(2 * raw[name]) / 2, 0.0), 1.0) for name in ("making_progress", "direction")}
    for score in (nuplan_score, vmax_score):
        result = float(score(values(**(raw | gates)))[0].value)
        assert 0.0 <= result <= 1.0
