from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drivax.evaluation.pairing import comparable, mismatch
from drivax.evaluation.result_tables import difference, headline_names, metric_label, sort_metrics, summarise
from drivax.metrics.catalogue import METRICS
from drivax.report.episodes import choose, outcome
from drivax.report.runs import read_runs
from drivax.stats.intervals import UNDEFINED, Interval, bootstrap_mean, rate

SEGMENTS = [f"hand/road-{number // 2}" for number in range(8)]


@pytest.fixture
def evaluations(runs):
    return read_runs(runs)[0]


def test_rates_have_wilson_intervals_and_other_means_a_bootstrap(evaluations):
    policy = evaluations[-1]
    assert summarise(policy, "collision") == rate(policy.metrics["collision"], SEGMENTS)
    progress = summarise(policy, "progress_ratio")
    expected = bootstrap_mean(policy.metrics["progress_ratio"], SEGMENTS, seed=1)
    assert (progress.mean, progress.n) == (expected.mean, expected.n)
    assert (progress.low, progress.high) == pytest.approx((expected.low, expected.high), abs=0.01)
    assert summarise(policy, "red_light").n == 5, "three of eight are undefined"
    assert summarise(policy, "min_ttc") == UNDEFINED == summarise(policy, "not_there")


def test_differences_are_paired_by_scenario(evaluations):
    expert, constant, policy = evaluations
    interval, verdict = difference(policy, constant, "progress_ratio")
    assert interval.mean == pytest.approx(0.1) and interval.n == 8 and verdict == "better"
    assert difference(policy, expert, "collision")[0].mean == pytest.approx(2 / 8)
    assert difference(policy, expert, "min_ttc")[0].n == 0
    assert difference(policy, policy, "accuracy")[1] == "same"
    assert difference(policy, expert, "red_light")[1] == "unclear"


def test_repeated_scenarios_are_averaged_in_any_order(evaluations):
    expert, _, policy = evaluations
    back = list(reversed(range(8)))
    keys = {name: tuple(column[i] for i in [*back, 0]) for name, column in expert.keys.items()}
    values = expert.metrics["progress_ratio"][[*back, 0]].copy()
    values[-1] += 0.4  # scenario 0 a second time: its mean is 0.2 more
    shuffled = dataclasses.replace(expert, keys=keys, metrics={"progress_ratio": values})
    interval, _ = difference(policy, shuffled, "progress_ratio")
    assert interval.n == 8 and interval.mean == pytest.approx(0.1 - 0.2 / 8)


def test_higher_is_worse_for_metrics_to_minimise(evaluations):
    expert, constant, _ = evaluations
    interval, verdict = difference(constant, expert, "offroad")
    assert interval.mean == 0.5 and verdict in ("worse", "unclear")
    values = {"offroad": np.ones(8)}
    certain = difference(dataclasses.replace(constant, metrics=values), expert, "offroad")
    assert certain == (Interval(1.0, 1.0, 1.0, 8), "worse")


def test_only_equal_scenarios_traffic_and_starts_are_compared(evaluations):
    expert, _, policy = evaluations
    assert comparable(expert, policy)
    other = dataclasses.replace(expert, info={**expert.info, "traffic": "idm"})
    moved = dataclasses.replace(expert, info={**expert.info, "data": {"hash": "0000", "path": "x"}})
    assert not comparable(other, policy) and not comparable(moved, policy)
    assert mismatch(other, policy) == (
        "differ in traffic (idm and log)", "evaluate both with the same --traffic",
    )  # fmt: skip
    (expert.folder / "config.yaml").write_text("noisy_start: true\nstart_step: 40\n")
    expert, policy = (dataclasses.replace(run) for run in (expert, policy))
    assert comparable(expert, policy), "of the policy's start nobody told anything"
    (policy.folder / "config.yaml").write_text("noisy_start: true\nstart_step: 10\n")
    expert, policy = (dataclasses.replace(run) for run in (expert, policy))
    assert mismatch(expert, policy) == (
        "differ in start_step (40 and 10)",
        "evaluate both with the same --start-step",
    )


def test_failures_of_each_kind_are_selected_in_turn(evaluations):
    policy = evaluations[-1]
    assert [outcome(policy, row) for row in range(8)] == [
        "success", "collision", "success", "off-road", "red light", "collision", "goal not reached", "success",
    ]  # fmt: skip
    chosen = choose(evaluations, 6)
    # Each kind in turn, gravest first; 5 and 1 are collisions that the others drove equally well or ill.
    assert [choice.outcome for choice in chosen] == [
        "collision", "off-road", "red light", "goal not reached", "success", "success",
    ]  # fmt: skip
    assert chosen[4].scenario_id == "hand-07", "the success where another planner failed comes first"
    assert all(choice.rows == (row, row, row) for choice in chosen for row in [int(choice.scenario_id[-2:])])
    assert len(choose(evaluations, 100)) == 8 and choose(evaluations, 0) == []
    assert sum(choice.outcome != "success" for choice in choose(evaluations, 8)) == 5


def test_groups_leave_out_runs_without_the_scenario_and_unmatched_runs(evaluations):
    expert, constant, policy = evaluations
    rows = [row for row, name in enumerate(constant.keys["scenario_id"]) if name != "hand-01"]
    constant = dataclasses.replace(
        constant,
        keys={name: tuple(column[row] for row in rows) for name, column in constant.keys.items()},
        metrics={name: values[rows] for name, values in constant.metrics.items()},
    )
    expert = dataclasses.replace(expert, info={**expert.info, "traffic": "idm"})
    rows = {choice.scenario_id: choice.rows for choice in choose([expert, constant, policy], 8)}
    assert rows["hand-01"] == (None, None, 1) and rows["hand-03"] == (None, 2, 3)


def test_metric_labels_and_order():
    assert all(metric_label(name).explanation for name in METRICS)
    assert metric_label("at_fault_collision").better == "low"
    assert metric_label("at_fault_collision").unit == "rate" and metric_label("vmax_score").unit == "share"
    assert metric_label("max_jerk").text == "max jerk [m/s³]"
    assert metric_label("my_metric").text == "my metric" and metric_label("my_metric").better == "-"
    assert metric_label("success").heading == "success ↑" and metric_label("offroad").heading == "off-road ↓"
    assert headline_names(["mine", "offroad", "success"]) == ["success", "offroad"]
    assert sort_metrics(["mine", "steps", "offroad", "yours", "success"]) == [
        "success",
        "offroad",
        "mine",
        "yours",
    ]
