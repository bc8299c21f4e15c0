"""User-defined metrics in results, run folder, table and report."""

import csv
import json
from dataclasses import replace

import pytest

from drivax.errors import UsageError
from drivax.evaluation.result_tables import planners_table
from drivax.evaluation.rollout import evaluation_task
from drivax.evaluation.runner import EvaluationConfig, evaluate, run_evaluation
from drivax.metrics.catalogue import Metric, select_metrics
from drivax.metrics.steps import STEP_VALUES, StepValue
from drivax.planners.catalogue import make_planner
from drivax.report.pages.report import explanations
from drivax.report.runs import read_runs
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.tasks.task import Task
from scenes import SMALL, bank_of, car, straight_road


@pytest.mark.slow
def test_own_metric_is_a_column_with_unit_and_direction(tmp_path):
    """Scenario 0: a car stands 30 m ahead of a standing ego. Scenario 1: no other agent, so the metric is undefined."""
    recordings = straight_road([car(), car(x=30.0)]), replace(straight_road([car()]), scenario_id="alone")
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        for recording in recordings:
            writer.add(assemble(recording, SMALL))
    config = EvaluationConfig("constant_velocity", metrics=("own_terms:nearest_other",))
    results = run_evaluation(
        config, make_planner("constant_velocity"), ScenarioSet.open(tmp_path / "set"), tmp_path / "run"
    )
    assert results.metrics["nearest_other"][0] == pytest.approx(30.0, abs=1e-4)
    assert results.summary()["metrics"]["nearest_other"]["n"] == 1
    with (tmp_path / "run" / "episodes.csv").open() as file:
        assert [row["nearest_other"] for row in csv.DictReader(file)] == ["30", ""]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["metrics"]["nearest_other"]["mean"] == pytest.approx(30.0, abs=1e-4)
    runs, _ = read_runs([tmp_path / "run"])
    table = planners_table(runs, ["nearest_other"]).html()
    assert "nearest other [m]" in table and "Higher is better" in table and "30.0" in table
    assert "Smallest distance between centres." in explanations(["nearest_other"], runs)


def test_own_metric_with_the_name_of_a_column_is_refused():
    bank, names = bank_of(straight_road([car()])), [{"dataset": "", "scenario_id": "a", "segment": "a"}]
    with pytest.raises(UsageError, match="the column 'crashed' already exists; rename your metric"):
        evaluate(make_planner("random"), bank, names, task=Task(metrics=("own_terms:crashed",)))


def test_invalid_metrics_are_refused():
    for name, words in (
        ("own_terms:hurry", "'own_terms:hurry' is not a metric"),
        ("own_terms:nearest", "did you mean 'nearest_other'"),
    ):
        with pytest.raises(UsageError, match=words):
            select_metrics(("full", name))


def test_own_metric_that_is_not_in_a_list_is_kept():
    task = evaluation_task(Task(metrics="own_terms:nearest_other"))
    assert task.metrics == ("full", "own_terms:nearest_other")
    assert select_metrics(("own_terms:nearest_other",) * 2).names == ("nearest_other",)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"better": "higher"}, "better is 'higher'; use one of low, high, -"),
        ({"operator": "median"}, "operator is 'median'; use one of any, sum"),
        (
            {"step_value": STEP_VALUES["jerk"], "operator": "last"},
            "'last' does not fit 'jerk', which is delayed",
        ),
    ],
)
def test_impossible_metrics_are_refused(options, words):
    metric = Metric("-", "low", "text", step_value=STEP_VALUES["ttc"], operator="max")
    # In tests the type checker would refuse the values before the class does.
    for name, value in options.items():
        object.__setattr__(metric, name, value)
    with pytest.raises(ValueError, match=words):
        metric.__post_init__()


def test_step_values_that_read_unknown_facts_are_refused():
    with pytest.raises(ValueError, match="'speed' reads unknown fact 'speed'"):
        StepValue("speed", "m/s", lambda moment: (moment.facts.speed, True), frozenset({"speed"}))
