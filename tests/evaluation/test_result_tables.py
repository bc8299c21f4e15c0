"""Tables of evaluations against hand-computed counts and the formulas that they name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.result_tables import (
    COLLISION_KINDS,
    collisions_table,
    differences_table,
    results_table,
    set_names,
    strata_table,
    transfer_table,
)
from drivax.simulator.contact import CollisionType
from drivax.stats.intervals import wilson

N = 12


def run(name, metrics, *, data="h1", path="sets/test", trained=None, traffic="log", planner=None):
    """An evaluation of twelve scenarios from twelve recordings."""
    info = {"planner": planner or name, "traffic": traffic, "data": [{"path": path, "hash": data}]}
    if trained:
        info["trained_on"] = [{"path": set_path, "hash": key} for set_path, key in trained]
    ids = tuple(f"s{number}" for number in range(N))
    keys = {"scenario_id": ids, "segment": ids, "dataset": ("d",) * N}
    return EpisodeTable(
        Path(name), name, info, keys, {n: np.array(v, np.float64) for n, v in metrics.items()}
    )


def means(table):
    return [
        [None if cell.interval is None else cell.interval.mean for cell in numbers(table, row)]
        for row in table.rows
    ]


def numbers(table, row):
    return [cell for column, cell in zip(table.columns, row, strict=True) if not column.label]


def heads(table):
    return tuple(column.key for column in table.columns if not column.label)


def labels(table):
    return [
        tuple(
            cell.metric or cell.text for column, cell in zip(table.columns, row, strict=True) if column.label
        )
        for row in table.rows
    ]


def test_results_and_differences():
    ours = run("ours", {"success": [1] * 9 + [0] * 3, "progress_ratio": np.linspace(0.5, 1, N)})
    theirs = run("theirs", {"success": [1] * 6 + [0] * 6, "progress_ratio": np.linspace(0.4, 0.9, N)})
    table = results_table([theirs, ours], ["success", "progress_ratio"])
    assert heads(table) == ("theirs", "ours") and labels(table) == [
        ("success",),
        ("progress_ratio",),
    ]
    assert means(table) == [[0.5, 0.75], [pytest.approx(0.65), pytest.approx(0.75)]]
    assert numbers(table, table.rows[0])[1].interval.as_dict() == pytest.approx(wilson(9, N).as_dict())
    other_set = run("elsewhere", {"success": [0] * N}, data="h2")
    table = differences_table(ours, [theirs, other_set], ["success", "progress_ratio"])
    assert heads(table) == ("theirs", "elsewhere")
    assert means(table) == [[pytest.approx(0.25), None], [pytest.approx(0.1), None]]
    assert numbers(table, table.rows[0])[1].text.startswith("no pairs:"), (
        "runs on other scenarios make no pairs"
    )
    low, high = numbers(table, table.rows[1])[0].interval.low, numbers(table, table.rows[1])[0].interval.high
    assert low == pytest.approx(0.1) == high, "all pairs differ by 0.1"


def test_collision_types_are_shares_of_episodes_with_a_known_type():
    kinds = [1, 1, 3, 6, 0, 0, 0, 0, 0, 0, np.nan, np.nan]
    table = collisions_table([run("a", {"collision_type": kinds}), run("old", {"success": [1] * N})])
    assert heads(table) == ("a",), "a run without types has no column"
    assert "share of the episodes with a known type" in table.caption
    whole = collisions_table([run("a", {"collision_type": [*kinds[:10], 0, 2]})])
    assert "share of all episodes" in whole.caption and {
        numbers(whole, row)[0].interval.n for row in whole.rows
    } == {N}
    assert set(COLLISION_KINDS) == set(CollisionType) - {CollisionType.NONE}
    result = dict(zip((label for label, *_ in labels(table)), means(table), strict=True))
    assert result["rear end"] == [0.2] and result["side"] == [0.1] and result["standing object"] == [0.1]
    assert result["head-on"] == [0.0]
    result = numbers(table, table.rows[0])[0].interval.as_dict()
    assert result == pytest.approx(wilson(2, 10).as_dict()), "undefined episodes do not count"


def test_strata_are_in_the_order_of_the_tag_values():
    tags = {("d", f"s{i}"): {"difficulty": "hard" if i < 3 else "easy"} for i in range(N - 1)}
    success = [1, 0, 0] + [1] * 9
    table = strata_table(
        [run("a", {"success": success}), run("b", {"success": [0] * N})], tags, "difficulty", ["success"]
    )
    assert labels(table) == [
        ("easy", "a"), ("easy", "b"), ("hard", "a"), ("hard", "b"), ("unknown", "a"), ("unknown", "b"),
    ]  # fmt: skip
    assert means(table) == [[1.0], [0.0], [pytest.approx(1 / 3)], [0.0], [1.0], [0.0]]
    assert [numbers(table, row)[0].interval.n for row in table.rows] == [8, 8, 3, 3, 1, 1]


def test_strata_of_runs_with_the_same_name():
    tags = {("d", f"s{i}"): {"difficulty": "easy" if i else "hard"} for i in range(N)}
    whole = run("a", {"success": [0] + [1] * (N - 1)})
    keys = {name: values[1:] for name, values in whole.keys.items()}
    rest = replace(whole, keys=keys, metrics={"success": whole.metrics["success"][1:]})
    table = strata_table([whole, rest], tags, "difficulty", ["success"])
    assert labels(table) == [("easy", "a"), ("easy", "a"), ("hard", "a")]
    assert means(table) == [[1.0], [1.0], [0.0]]
    assert [numbers(table, row)[0].interval.n for row in table.rows] == [N - 1, N - 1, 1]


def test_scenarios_of_several_types_count_in_each():
    types = ["stopping_with_lead|near_multiple_vehicles", "stopping_with_lead"] + ["changing_lane"] * (N - 3)
    tags = {("d", f"s{i}"): {"scenario_types": words} for i, words in enumerate(types)}
    success = [1, 0] + [1] * (N - 2)
    table = strata_table([run("a", {"success": success})], tags, "scenario_types", ["success"])
    assert [label for label, _ in labels(table)] == [
        "changing_lane", "near_multiple_vehicles", "stopping_with_lead", "unknown",
    ]  # fmt: skip
    assert means(table) == [[1.0], [1.0], [0.5], [1.0]]
    assert [numbers(table, row)[0].interval.n for row in table.rows] == [N - 3, 1, 2, 1]


def test_transfer_is_training_by_evaluation():
    runs = [
        run(
            "p (1)", {"success": [1] * 6 + [0] * 6}, data="A", path="x/a", trained=[("x/a", "A")], planner="p"
        ),
        run(
            "p (2)", {"success": [1] * 3 + [0] * 9}, data="B", path="x/b", trained=[("x/a", "A")], planner="p"
        ),
        run("q", {"success": [1] * N}, data="B", path="x/b", trained=[("x/b", "B"), ("x/a", "A")]),
        run("idm", {"success": [0] * N}, data="A", path="x/a"),
    ]
    table = transfer_table(runs, "success")
    assert heads(table) == ("a", "b")
    assert labels(table) == [
        ("p", "a", "log"),
        ("q", "b, a", "log"),
        ("idm", "–", "log"),
    ]
    assert means(table) == [[0.5, 0.25], [None, 1.0], [0.0, None]]
    twice = [
        runs[0],
        run("p (noisy)", {"success": [1] * N}, data="A", path="x/a", trained=[("x/a", "A")], planner="p"),
    ]
    assert [label for label, *_ in labels(transfer_table(twice, "success"))] == ["p", "p (noisy)"]


def test_policies_of_one_name_are_distinguished(tmp_path):
    """Every algorithm has a ``seed-0``; only their names on the command line differ."""
    runs, cases = [], [("runs/bc/seed-0", "A"), ("runs/ppo/seed-0", "A"), ("runs/bc/seed-0", "B")]
    for number, (planner, data) in enumerate(cases):
        metrics, folder = {"success": [number % 2] * N}, tmp_path / str(number)
        evaluation = run(f"seed-0 ({number})", metrics, data=data, path=f"x/{data}", planner="seed-0")
        folder.mkdir()
        (folder / "config.yaml").write_text(f"planner: {planner}\n")
        runs.append(replace(evaluation, folder=folder))
    table = transfer_table(runs, "success")
    assert [label for label, *_ in labels(table)] == ["bc/seed-0", "ppo/seed-0"]
    assert means(table) == [[0.0, 0.0], [1.0, None]]
    assert [cell.link["run"] for cell in numbers(table, table.rows[0])] == ["seed-0 (0)", "seed-0 (2)"]


def test_sets_of_one_name_are_distinguished():
    runs = [
        run("a", {}, data="0123456789", path="old/test"),
        run("b", {}, data="abcdefghij", path="new/test"),
    ]
    assert set_names(runs) == {"0123456789": "test 012345", "abcdefghij": "test abcdef"}
    assert set_names([run("a", {}, data=None, path="old/test")]) == {"old/test": "test"}
    unhashed = [run("a", {}, data=None, path=f"/data/{name}/test") for name in ("old", "new")]
    assert set(set_names(unhashed).values()) == {"test (/data/old/test)", "test (/data/new/test)"}
