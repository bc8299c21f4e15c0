"""Episodes depend only on their scenario, crashes fail episodes, and the audit finds violations."""

import csv
import json
import shutil
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

import drivax
from drivax.api import load
from drivax.errors import DataError, UsageError
from drivax.evaluation.audit import audit, scenario_names
from drivax.evaluation.episode_table import ADDED, FAILED, KEYS, Crash, EpisodeTable, fail_crashed
from drivax.evaluation.result_tables import paired_difference, summarise
from drivax.evaluation.runner import (
    EvaluationConfig,
    evaluate,
    format_crashes,
    format_summary,
    run_evaluation,
)
from drivax.metrics.catalogue import METRICS, headline
from drivax.planners.simple import Expert
from drivax.scenario.bank.scenario_bank import ScenarioBank, identities
from drivax.scenario.build.assemble import assemble
from drivax.scenario.record import record
from drivax.scenario.schema import Flag
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.simulator.starts import NoisyStart
from drivax.synthetic.world import generate_recording
from drivax.tasks.actions import PUBLISHED
from drivax.tasks.task import Task
from own_drivers import fragile, plain
from scenes import GLIMPSE, SMALL, bank_of, car, straight_road

COUNT = 9


@pytest.fixture(scope="module")
def scenarios():
    return [assemble(generate_recording(9, i)) for i in range(COUNT)]


@pytest.fixture(scope="module")
def data(scenarios):
    return load(scenarios)


@pytest.fixture(scope="module")
def driven(data):
    """Evaluate some of the scenarios, all in one program."""

    def drive(some, planner=None, batch=4, seed=0):
        return evaluate(
            planner or fragile(), some, task=Task(observation=GLIMPSE), start=NoisyStart(), batch=batch, seed=seed,
            sizes=data.sizes,
        )  # fmt: skip

    return drive


@pytest.fixture(scope="module")
def whole(scenarios, driven):
    return driven(scenarios)


def by_scenario(results):
    rows = results.rows()
    names = [row["scenario_id"] for row in rows]
    assert len(set(names)) == len(rows)
    return {
        name: (row, motion.tobytes())
        for name, row, motion in zip(names, rows, results.trajectories.ego, strict=True)
    }


@pytest.mark.slow
def test_episodes_do_not_depend_on_batches_order_or_other_scenarios(scenarios, whole, driven):
    expected = by_scenario(whole)
    assert len(expected) == COUNT
    for batch in (1, 3, 8, 64):
        assert by_scenario(driven(scenarios, batch=batch)) == expected, batch
    shuffled = [scenarios[i] for i in np.random.default_rng(2).permutation(COUNT)]
    assert by_scenario(driven(shuffled)) == expected
    some = by_scenario(driven(scenarios[5:2:-1], batch=2))
    assert some == {name: expected[name] for name in some} and len(some) == 3
    assert by_scenario(driven(scenarios, seed=1)) != expected
    copies = driven([scenarios[0], scenarios[0]], batch=1)
    assert (
        copies.trajectories.ego[0].tobytes()
        == expected[scenarios[0].id][1]
        != copies.trajectories.ego[1].tobytes()
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "planner",
    ["expert", "constant_velocity", "idm", "random", "pdm", "search_planner:SearchPlanner", "zoo:aggressive"],
)
def test_built_in_planners_do_not_depend_on_batches_order_or_other_scenarios(scenarios, planner, tmp_path):
    with ScenarioWriter(tmp_path / "set", scenarios[0].capacity) as writer:
        for scenario in scenarios:
            writer.add(scenario)
    expected = by_scenario(drivax.evaluate(planner, tmp_path / "set", traffic="idm"))
    ids = [scenario.id for scenario in scenarios[:3:-1]]
    for data, options in ((tmp_path / "set", {"batch": 2}), (load(tmp_path / "set", scenarios=ids), {})):
        result = by_scenario(drivax.evaluate(planner, data, traffic="idm", **options))
        assert result == {name: expected[name] for name in result} and len(result) in (COUNT, len(ids))


def test_stored_actions_reproduce_the_motion(whole):
    """The first dimension of an action is the acceleration over 6 m/s2, applied for 0.1 s."""
    assert whole.trajectories.action.shape == (COUNT, 80, 2) and np.abs(whole.trajectories.action).max() <= 1
    before, after = whole.trajectories.ego[:, :-1, 3], whole.trajectories.ego[:, 1:, 3]
    drives = after > 0.01
    assert drives.mean() > 0.5
    np.testing.assert_allclose(
        (after - before)[drives], 0.6 * whole.trajectories.action[..., 0][drives], atol=1e-4
    )
    assert whole.rows()[0]["action_jerk"] == f"{whole.metrics['action_jerk'][0]:.6g}" != "0"


def test_every_planner_has_the_same_noisy_starts(scenarios, whole, driven):
    other = driven(scenarios[2:6], fragile(share=0.0))
    np.testing.assert_array_equal(other.trajectories.ego[:, 0], whole.trajectories.ego[2:6, 0])
    assert (other.trajectories.ego[:, -1] != whole.trajectories.ego[2:6, -1]).any(axis=1).all()
    again = driven(scenarios[2:6], fragile(share=0.0), seed=1)
    assert (other.trajectories.ego[:, 0] != again.trajectories.ego[:, 0]).any()


@pytest.fixture(scope="module")
def crashed(scenarios, data, driven):
    return driven(scenarios, fragile(breaks=data.bank.identity[3], step=40))


def test_crash_fails_its_episode_and_changes_no_other(scenarios, whole, crashed):
    assert crashed.crashes == (Crash("drivax", scenarios[3].id, 40, "action is not finite"),)
    before, after = by_scenario(whole), by_scenario(crashed)
    assert {name for name in before if before[name] != after[name]} == {scenarios[3].id}
    np.testing.assert_array_equal(crashed.trajectories.ego[3, :31], whole.trajectories.ego[3, :31])
    assert (crashed.trajectories.ego[3, 31:] == crashed.trajectories.ego[3, 30]).all(), (
        "ego's motion repeats after the crash"
    )
    np.testing.assert_array_equal(crashed.trajectories.action[3, :30], whole.trajectories.action[3, :30])
    assert (
        np.isnan(crashed.trajectories.action[3, 30:]).all()
        and np.isfinite(crashed.trajectories.action[4:]).all()
    )
    row, complete = after[scenarios[3].id][0], before[scenarios[3].id][0]
    assert row["crashed"] == "1" and complete["crashed"] == "0"
    for name in FAILED:
        assert row[name] == ("0" if complete[name] != "" else ""), name
    # The other metrics cover the 30 steps before the crash.
    moved = np.hypot(*np.diff(whole.trajectories.ego[3, :31, :2], axis=0).T).sum()
    assert float(row["distance"]) == pytest.approx(moved, abs=0.05) and row["steps"] == "30"
    assert 0 < float(row["progress_ratio"]) < float(complete["progress_ratio"])
    assert row["vmax_score"] == "0" and row["success"] == "0"
    for name in ("accuracy", "success", "vmax_score"):
        one, other = (results.summary()["metrics"][name] for results in (whole, crashed))
        assert one["n"] == other["n"] == COUNT, "the crashed episode stays in the denominator"
        assert other["mean"] * COUNT == pytest.approx(one["mean"] * COUNT - float(complete[name]))
    assert crashed.summary()["metrics"]["crashed"]["mean"] == pytest.approx(1 / COUNT)


def test_crash_has_scenario_step_and_error(scenarios, crashed, whole, tmp_path):
    crashed.write(tmp_path)
    result = json.loads((tmp_path / "crashes.json").read_text())
    assert result == [
        {"dataset": "drivax", "scenario_id": scenarios[3].id, "step": 40, "error": "action is not finite"}
    ]
    with (tmp_path / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [*KEYS, *METRICS, *ADDED]
    (tmp_path / "run.json").write_text('{"kind": "evaluation", "planner": "fragile"}')
    stored = EpisodeTable.read(tmp_path)
    assert stored.crashes == crashed.crashes and stored.keys == crashed.keys
    assert stored.metrics["crashed"].tolist() == [float(row == 3) for row in range(COUNT)]
    lines = format_crashes(crashed).splitlines()
    assert lines == [
        "fragile crashed in 1 of 9 episodes, which count as failed:",
        f"  {scenarios[3].id}, step 40: action is not finite",
    ]
    assert format_crashes(whole) == ""
    same = paired_difference(crashed, whole, "success")
    assert same.n == COUNT and same.mean <= 0
    elsewhere = dict(whole.keys) | {"dataset": ("other",) * COUNT}
    assert paired_difference(crashed, replace(whole, keys=elsewhere), "success").n == 0


def test_summary_has_the_intervals_of_the_tables(whole, tmp_path):
    """Segments of two data sets may have the same name; scenarios without a segment are their own clusters."""
    names = {
        "dataset": tuple(f"set-{row % 2}" for row in range(COUNT)),
        "segment": tuple("a" if row < 4 else "" for row in range(COUNT)),
    }
    mixed = replace(whole, keys=dict(whole.keys) | names)
    assert len(set(mixed.clusters)) == 2 + COUNT - 4
    mixed.write(tmp_path)
    (tmp_path / "run.json").write_text('{"kind": "evaluation", "planner": "fragile"}')
    stored, summary = (
        EpisodeTable.read(tmp_path),
        json.loads((tmp_path / "summary.json").read_text())["metrics"],
    )
    for name in ("success", "offroad", "progress_ratio"):
        interval = summarise(stored, name).as_dict()
        assert summary[name] == pytest.approx(interval, rel=1e-4), name


def test_fail_crashed_equals_hand_computed_values():
    nan = np.nan
    result = fail_crashed(
        {
            "success": np.array([1.0, 1.0, nan]), "vmax_score": np.array([0.5, nan, 0.7]),
            "vmax_score_partial": np.array([nan, 0.9, nan]), "collision": np.array([0.0, 0.0, 1.0]),
            "own": np.array([3.0, 4.0, 5.0]),
        },
        np.array([False, True, True]),
    )  # fmt: skip
    assert list(result) == ["success", "vmax_score", "vmax_score_partial", "collision", "crashed", "own"]
    expected = {
        "success": [1.0, 0.0, nan], "vmax_score": [0.5, nan, 0.0], "vmax_score_partial": [nan, 0.0, nan],
        "collision": [0.0, 0.0, 1.0], "crashed": [0.0, 1.0, 1.0], "own": [3.0, 4.0, 5.0],
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_array_equal(result[name], values, err_msg=name)


def test_planner_of_another_action_space_is_refused(data):
    with pytest.raises(UsageError, match="another action space"):
        evaluate(Expert(), data.bank, data.names, task=Task(actions=PUBLISHED))


def test_planner_finds_scenarios_whose_hashes_are_equal():
    """The hashes of the two ids are equal; the identity of the later one is another."""
    ids, asked = ("44662", "169336"), []
    scenarios = [assemble(replace(straight_road([car()]), scenario_id=name), SMALL) for name in ids]
    dataset = scenario_names(scenarios)[0]["dataset"]
    numbers = identities([(dataset, name) for name in ids]).tolist()
    assert numbers[:1] == identities([(dataset, ids[0])]).tolist() == identities([(dataset, ids[1])]).tolist()

    class EnoughError(Exception):
        """Ends the evaluation before its program is compiled."""

    @record
    class Prepared(Expert):
        def prepare(self, scenario_of):
            asked.extend(scenario_names([scenario_of(number)])[0]["scenario_id"] for number in numbers)
            raise EnoughError

    with pytest.raises(EnoughError):
        evaluate(Prepared(), scenarios)
    assert asked == list(ids)


def test_plain_function_is_refused_as_planner(data):
    with pytest.raises(UsageError, match=r"'plain' takes \(situation, observation\).*@drivax.python_planner"):
        drivax.evaluate(plain, data)


def test_audit_finds_violations_of_the_log():
    clean = straight_road([car(0, 0, 0, 8), car(30, 0, 0, 8)])
    crash = straight_road([car(0, 0, 0, 8), car(30, 0, 0, 0)])
    leaves = straight_road([car(0, 0, np.deg2rad(-3), 10)])
    jumps = straight_road([car(0, 0, 0, 10)], light=4)
    together = straight_road([car(0, 0, 0, 5), car(1, 0.5, 0, 5)])
    result = audit([assemble(r) for r in (clean, crash, leaves, jumps, together)])
    assert [row["log_collides"] for row in result] == [False, True, False, False, False]
    assert [row["log_runs_red"] for row in result] == [False, False, False, True, False]
    assert [row["clean"] for row in result] == [True, False, False, False, True]
    assert result[2]["log_offroad_fraction"] > 0.1 and result[2]["first_offroad_step"] > 10
    assert result[0]["first_offroad_step"] is None and result[0]["distance_m"] == pytest.approx(64, abs=0.1)
    assert [row["ignored_overlaps"] for row in result] == [0, 0, 0, 0, 1]


def test_start_step_without_an_action_is_refused():
    bank = bank_of(straight_road([car(0, 0, 0, 8)]))
    names = [{"dataset": "test", "scenario_id": "a", "segment": "a"}]
    for step in (90, -1):
        with pytest.raises(UsageError, match=f"no episode can start at step {step}; use 0 to 89"):
            evaluate(Expert(), bank, names, start_step=step)


def named(recording, name):
    return assemble(replace(recording, scenario_id=name), SMALL)


def cut(recording, steps):
    """The first steps of a recording."""
    tracks = {
        field.name: value[:, :steps] if value.ndim > 1 else value
        for field in fields(recording.tracks)
        for value in [getattr(recording.tracks, field.name)]
    }
    timestamps_s = recording.timestamps_s[:steps]
    return replace(recording, tracks=replace(recording.tracks, **tracks), timestamps_s=timestamps_s)


def test_scenarios_without_ego_or_future_are_refused_with_a_filter():
    late = straight_road([car(steps=range(5, 91)), car(30)])
    gap = straight_road([car(steps=[*range(40), *range(50, 91)])])
    logs = [named(straight_road([car()]), "good"), named(late, "late"), named(gap, "gap")]
    for step, message in ((45, "1 of 3 .*'scenario_id!=gap'"), (2, "1 of 3 .*'scenario_id!=late'")):
        with pytest.raises(UsageError, match=rf"not in the log at step {step} in {message}"):
            evaluate(fragile(), logs, start=NoisyStart(), start_step=step)
    short = named(cut(straight_road([car()]), 11), "short")
    assert Flag.NO_FUTURE in short.has
    with pytest.raises(
        DataError, match=r"record short: has 11 steps, fewer than 31.*1 of 4.*flag!=NO_FUTURE"
    ):
        evaluate(fragile(), [*logs, short], start=NoisyStart())
    bank = ScenarioBank.from_scenarios([logs[0], short], allow_no_future=True)
    with pytest.raises(DataError, match=r"record short: has 11 steps.*1 of 2"):
        evaluate(fragile(), bank, scenario_names([logs[0], short]), start=NoisyStart())
    with pytest.raises(UsageError, match="batch of 0"):
        evaluate(fragile(), logs, start=NoisyStart(), batch=0)


def test_disk_space_is_checked_before_the_first_episode(scenarios, tmp_path, monkeypatch):
    with ScenarioWriter(tmp_path / "set", scenarios[0].capacity) as writer:
        for scenario in scenarios:
            writer.add(scenario)

    def fail(*_, **__):
        pytest.fail("an episode was evaluated")

    monkeypatch.setattr("drivax.evaluation.runner.evaluate", fail)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=1 << 60, free=1_000))
    config = EvaluationConfig(planner="expert", traffic="idm")
    with pytest.raises(DataError, match=r"run: no space: needs about \d+ kB, the disk has 1 kB left"):
        run_evaluation(config, Expert(), ScenarioSet.open(tmp_path / "set"), tmp_path / "run")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_unknown_options_are_refused():
    with pytest.raises(TypeError, match="unexpected keyword argument 'sed'"):
        evaluate(Expert(), [], sed=3)


def test_no_scenarios_are_refused():
    with pytest.raises(UsageError, match="no scenarios to evaluate"):
        evaluate(Expert(), [])


def test_start_at_the_last_step_of_a_log_is_refused():
    logs = [named(straight_road([car()]), "good"), named(cut(straight_road([car()]), 41), "short")]
    with pytest.raises(UsageError, match="short: the log has no action after step 40 in 1 of 2"):
        evaluate(fragile(), logs, start=NoisyStart(), start_step=40)


def test_summary_has_all_headline_metrics_of_all_planners_within_100_columns():
    values = {name: {"mean": rank / 8} for rank, name in enumerate(METRICS)}
    values["red_light"] = {"mean": None}
    planners = ["expert", "constant_velocity", "policy (route)", "own_drivers:cruise", "idm", "x" * 60]
    tables = format_summary([{"planner": name, "metrics": values} for name in planners]).split("\n\n")
    for text, names in zip(tables, (planners[:5], planners[5:]), strict=True):
        heading, *lines = text.splitlines()
        assert max(map(len, (heading, *lines))) <= 100
        assert len(lines) == len(headline(METRICS)) and lines[0].split() == [
            "success",
            *["0.250"] * len(names),
        ]
        assert [line for line in lines if not line[-1].isdigit()] == ["red light"]
        assert any(line.split()[:3] == ["at-fault", "collision", "1.125"] for line in lines)
    assert tables[0].split("\n")[0].split() == ["metric", *" ".join(planners[:5]).split()]
