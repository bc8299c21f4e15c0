"""Evaluation: batching never changes a result, the audit finds what was put in, runs appear whole or not at all."""

import numpy as np
import pytest

from drivax.api import load
from drivax.errors import UsageError
from drivax.evaluation import runner
from drivax.evaluation.audit import audit
from drivax.evaluation.results import paired_differences
from drivax.evaluation.runner import evaluate
from drivax.planners.simple import ConstantVelocity, Expert
from drivax.scenario.assemble import assemble
from drivax.synthetic.world import generate_recording
from drivax.tasks.actions import PUBLISHED
from drivax.tasks.task import Task
from scenes import bank_of, car, straight_road


@pytest.fixture(scope="module")
def data():
    return load([assemble(generate_recording(9, i)) for i in range(5)])


def test_batches_change_nothing_and_none_is_dropped(data, monkeypatch):
    whole = evaluate(ConstantVelocity(), data.bank, data.names)
    monkeypatch.setattr(runner, "BATCH", 2)
    parts = evaluate(ConstantVelocity(), data.bank, data.names)
    assert len(parts) == 5
    np.testing.assert_array_equal(whole.motion, parts.motion)
    for name, values in whole.metrics.items():
        np.testing.assert_allclose(values, parts.metrics[name], rtol=1e-6, err_msg=name)
    same = paired_differences(whole, parts, "success")
    assert (same.mean, same.n) == (0.0, 5)
    with pytest.raises(UsageError, match="different scenarios"):
        paired_differences(whole, evaluate(ConstantVelocity(), data.bank, data.names[::-1]), "success")


def test_a_planner_of_another_action_space_is_refused(data):
    with pytest.raises(UsageError, match="another action space"):
        evaluate(Expert(), data.bank, data.names, task=Task(actions=PUBLISHED))


def test_the_audit_finds_what_the_log_does_wrong():
    clean = straight_road([car(0, 0, 0, 8), car(30, 0, 0, 8)])
    crash = straight_road([car(0, 0, 0, 8), car(30, 0, 0, 0)])
    leaves = straight_road([car(0, 0, np.deg2rad(-3), 10)])
    jumps = straight_road([car(0, 0, 0, 10)], light=4)
    together = straight_road([car(0, 0, 0, 5), car(1, 0.5, 0, 5)])
    found = audit([assemble(r) for r in (clean, crash, leaves, jumps, together)])
    assert [row["log_collides"] for row in found] == [False, True, False, False, False]
    assert [row["log_runs_red"] for row in found] == [False, False, False, True, False]
    assert [row["clean"] for row in found] == [True, False, False, False, True]
    assert found[2]["log_offroad_fraction"] > 0.1 and found[2]["first_offroad_step"] > 10
    assert found[0]["first_offroad_step"] is None and found[0]["distance_m"] == pytest.approx(64, abs=0.1)
    assert [row["ignored_overlaps"] for row in found] == [0, 0, 0, 0, 1]


def test_a_start_step_without_an_action_is_refused():
    bank = bank_of(straight_road([car(0, 0, 0, 8)]))
    names = [{"dataset": "test", "scenario_id": "a", "segment": "a"}]
    with pytest.raises(UsageError, match="leaves no action"):
        evaluate(Expert(), bank, names, start_step=90)
