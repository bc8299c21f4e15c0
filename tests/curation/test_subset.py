"""The most critical scenarios of a set: order, one scenario per recording, and the exported set."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivax.cli import main
from drivax.curation import scores
from drivax.curation.methods import Request, curate
from drivax.curation.scores import ScoreTable, check_top, read_scores, top_rows, write_scores, write_top
from drivax.errors import DataError, UsageError
from drivax.report.pages.viewer import criticality_html
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.stats.clusters import recordings_of
from scenes import SMALL, car, straight_road

#: Data set and recording of each scenario.
SOURCES = (("a", "one"), ("a", "one"), ("a", "two"), ("b", "one"), ("a", "four"), ("a", "five"))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Six scenarios of five recordings; the second one ends early."""
    path = tmp_path_factory.mktemp("subset") / "set"
    with ScenarioWriter(path, SMALL) as writer:
        for row, (dataset, segment) in enumerate(SOURCES):
            cars = [car(speed=8.0 + row, steps=range(40 if row == 1 else 91)), car(x=30.0, speed=8.0)]
            drive = replace(straight_road(cars), scenario_id=f"drive-{row}", dataset=dataset, segment=segment)
            writer.add(assemble(drive, SMALL))
    return ScenarioSet.open(path)


def hand_made(data, scenarios, means=None):
    """A table with given scores of scenarios and means of their valid steps."""
    valid = np.stack([np.asarray(scenario.record["agent_valid"][:, 0], bool) for scenario in data])
    means = np.zeros(len(data)) if means is None else np.asarray(means)
    steps = np.where(valid, means[:, None], 0.0)
    ids = tuple(entry["scenario_id"] for entry in data.entries)
    return ScoreTable("kinematic", {}, data.hash, ids, valid, steps, np.asarray(scenarios, float), {})


def test_ties_are_ordered_by_mean_step_score_then_index(data):
    table = hand_made(data, [0.5, 0.5, 0.9, 0.5, 0.5, 0.1], [0.1, 0.2, 0.0, 0.3, 0.2, 0.9])
    # The second counts its 40 steps only: over all 91 its mean would be below that of the first.
    assert top_rows(table, 6) == [2, 3, 1, 4, 0, 5]
    assert top_rows(table, 2) == [2, 3]
    ranks = [criticality_html(table, row).split("rank ")[1].split(" of ")[0] for row in range(6)]
    assert ranks == ["5", "3", "1", "2", "4", "6"]


def test_order_survives_a_round_trip(data, tmp_path):
    """Files round to float32, so scores that are equal in float32 are ties."""
    near = 0.5 + 1e-12 * np.arange(6)
    table = hand_made(data, near, [0.3, 0.1, 0.2, 0.6, 0.5, 0.4])
    write_scores(table, tmp_path / "scores.npz")
    assert top_rows(table, 6) == top_rows(read_scores(tmp_path / "scores.npz", data), 6) == [3, 4, 5, 0, 2, 1]
    table = hand_made(data, np.full(6, 0.5), near)
    assert top_rows(table, 6) == [0, 1, 2, 3, 4, 5]


def test_the_most_critical_of_each_recording(data):
    """Only one scenario per recording is selected; recordings of other data sets may have the same name."""
    table = hand_made(data, [0.8, 0.9, 0.1, 0.3, 0.7, 0.6])
    recordings = recordings_of(data.entries)
    assert len(set(recordings)) == 5 and recordings[0] == recordings[1]
    assert top_rows(table, 3) == [1, 0, 4]
    assert top_rows(table, 3, recordings) == [1, 4, 5]
    assert top_rows(table, 6, recordings) == [1, 4, 5, 3, 2]


def test_subset_holds_one_scenario_of_each_recording_by_default(data, tmp_path):
    table = hand_made(data, [0.8, 0.9, 0.1, 0.3, 0.7, 0.6])
    for all_windows, rows in ((False, [1, 4, 5]), (True, [1, 0, 4])):
        out = tmp_path / str(all_windows)
        write_top(table, data, 3, out, all_windows=all_windows)
        top = ScenarioSet.open(out)
        assert [entry["scenario_id"] for entry in top.entries] == [f"drive-{row}" for row in rows]
        part = top.manifest["source"]["part_of"]
        assert (part["most_critical"], part["all_windows"]) == (3, all_windows)


def test_count_beyond_the_recordings_is_refused(data, tmp_path, capsys):
    message = (
        "cannot select 6 scenarios from 5 recordings, one of each; "
        "ask for 1 to 5, or pass --all-windows to choose among all 6 scenarios"
    )
    with pytest.raises(UsageError, match=message):
        check_top(data, tmp_path / "top", 6)
    for count in (0, 7):
        with pytest.raises(UsageError, match=r"one of each; ask for 1 to 5$"):
            check_top(data, tmp_path / "top", count)
    check_top(data, tmp_path / "top", 5)
    check_top(data, tmp_path / "top", 6, all_windows=True)
    with pytest.raises(UsageError, match="cannot select 7 of 6 scenarios; ask for 1 to 6"):
        check_top(data, tmp_path / "top", 7, all_windows=True)
    command = ["curate", "uniform", "--data", str(data.path), "--out", str(tmp_path / "scores.npz")]
    assert main([*command, "--export", str(tmp_path / "top"), "6"]) == 2
    assert message in capsys.readouterr().err
    assert main([*command, "--all-windows"]) == 2
    assert "--all-windows without a subset to choose; pass --export TOP N" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main([*command, "--export", str(tmp_path / "top"), "6", "--all-windows"]) == 0
    assert len(ScenarioSet.open(tmp_path / "top")) == 6


def test_subset_folder_holds_its_scores(data, tmp_path, monkeypatch):
    table = curate("kinematic", Request(data))
    rows = top_rows(table, 3, recordings_of(data.entries))
    write_top(table, data, 3, tmp_path / "top")
    top = ScenarioSet.open(tmp_path / "top")
    top.check()
    own = read_scores(tmp_path / "top" / "scores.npz", top)
    assert own.method == "kinematic" and own.order.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(own.valid, table.valid[rows])
    np.testing.assert_allclose(own.steps, table.steps[rows], atol=1e-6)
    np.testing.assert_allclose(own.scenarios, table.scenarios[rows], atol=1e-6)
    assert set(own.components) == set(table.components)
    for name, part in table.components.items():
        np.testing.assert_allclose(own.components[name], part[rows], atol=1e-6)
    part = {"set": "set", "hash": data.hash, "most_critical": 3, "all_windows": False}
    assert own.config["part_of"] == part and own.combination == table.combination
    assert own.config["urgent_s"] == table.config["urgent_s"]
    # The scores of the whole set are refused for the subset; the message names the subset's own.
    write_scores(table, tmp_path / "whole.npz")
    with pytest.raises(DataError, match=r"scores belong to another set .*; use .*top/scores\.npz"):
        read_scores(tmp_path / "whole.npz", top)
    # It does not name the file that was given, however its path is written.
    write_scores(table, top.path / "scores.npz", overwrite=True)
    monkeypatch.chdir(top.path)
    with pytest.raises(DataError, match=r"scores belong to another set .*; run `drivax curate` again"):
        read_scores(Path("scores.npz"), top)


def test_failed_subset_leaves_no_folder(data, tmp_path, monkeypatch):
    table = hand_made(data, [0.8, 0.9, 0.1, 0.3, 0.7, 0.6])
    write_top(table, data, 1, tmp_path / "top")
    monkeypatch.setattr(scores, "write_scores", lambda *_: 1 / 0)
    for name in ("top", "other"):
        with pytest.raises(ZeroDivisionError):
            write_top(table, data, 2, tmp_path / name, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["top"]
    top = ScenarioSet.open(tmp_path / "top")
    assert read_scores(tmp_path / "top" / "scores.npz", top).scenario_ids == ("drive-1",)


def test_command_prints_the_most_critical(data, tmp_path, capsys):
    out, top = tmp_path / "scores.npz", tmp_path / "top"
    command = ["curate", "kinematic", "--data", str(data.path), "--export", str(top), "3"]
    for inside in (top, top / "scores.npz"):
        assert main([*command, "--out", str(inside)]) == 2
        assert "output is inside the --export folder; choose another --out" in capsys.readouterr().err
        assert not list(tmp_path.iterdir())
    assert main([*command, "--out", str(out)]) == 0
    lines = capsys.readouterr().out.replace(str(tmp_path), "").splitlines()
    assert max(map(len, lines)) < 100
    first = lines.index("/top: the 3 most critical scenarios, at most one per recording")
    assert lines[first + 1 : first + 3] == ["/top/scores.npz: their scores", "  rank  score  scenario"]
    table = read_scores(out, data)
    rows = top_rows(table, 3, recordings_of(data.entries))
    assert [line.split() for line in lines[first + 3 :]] == [
        [str(rank), f"{table.scenarios[row]:.3f}", f"drive-{row}"] for rank, row in enumerate(rows, start=1)
    ]


def test_other_commands_accept_the_subset_and_its_scores(data, tmp_path, capsys):
    top = tmp_path / "top"
    begin = ["curate", "kinematic", "--data", str(data.path), "--out", str(tmp_path / "scores.npz")]
    assert main([*begin, "--export", str(top), "3"]) == 0
    own, page, again = top / "scores.npz", tmp_path / "top.html", tmp_path / "again.npz"
    assert main(["inspect", str(top)]) == 0
    assert main(["view", str(top), "--scores", str(own)]) == 0
    best = ScenarioSet.open(top)[0].id
    assert "rank 1 of 3 by kinematic" in page.read_text() and best in page.read_text()
    assert main(["curate", "kinematic", "--data", str(top), "--out", str(again)]) == 0
    np.testing.assert_allclose(
        read_scores(again, ScenarioSet.open(top)).steps,
        read_scores(own, ScenarioSet.open(top)).steps,
        atol=1e-6,
    )
    best_of = ["--again", str(own), "--weights", "urgency", "1", "--export", str(tmp_path / "best"), "1"]
    assert (
        main(["curate", "kinematic", "--data", str(top), "--out", str(again), "--overwrite", *best_of]) == 0
    )
    control = [
        "--like",
        str(own),
        "--out",
        str(tmp_path / "control.npz"),
        "--export",
        str(tmp_path / "drawn"),
        "2",
    ]
    assert main(["curate", "random_matched", "--data", str(top), *control]) == 0
    drawn = ScenarioSet.open(tmp_path / "drawn")
    assert read_scores(tmp_path / "drawn" / "scores.npz", drawn).method == "random_matched"


@pytest.mark.slow
def test_subset_can_be_evaluated(data, tmp_path):
    top, run = tmp_path / "top", tmp_path / "run"
    write_top(hand_made(data, [0.8, 0.9, 0.1, 0.3, 0.7, 0.6]), data, 2, top)
    drive = ["evaluate", "--planner", "constant_velocity", "--data", str(top), "--out", str(run)]
    assert main([*drive, "--traffic", "log", "--metrics", "none"]) == 0
    with (run / "episodes.csv").open() as file:
        assert [row["scenario_id"] for row in csv.DictReader(file)] == ["drive-1", "drive-4"]
