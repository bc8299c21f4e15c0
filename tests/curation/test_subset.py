"""The most critical scenarios of a set: their order, at most one of each recording, and the set that they become."""

from dataclasses import replace

import numpy as np
import pytest

from drivax.cli import main
from drivax.curation.scores import ScoreTable, read_scores, write_scores
from drivax.curation.subset import check_top, top_rows, write_top
from drivax.errors import UsageError
from drivax.evaluation.clusters import recordings_of
from drivax.scenario.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.show.criticality import criticality_html
from scenes import SMALL, car, straight_road

#: Data set and recording of each scenario.
SOURCES = (("a", "one"), ("a", "one"), ("a", "two"), ("b", "one"), ("a", "four"), ("a", "five"))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Six drives of five recordings; the second one ends early."""
    path = tmp_path_factory.mktemp("subset") / "set"
    with ScenarioWriter(path, SMALL) as writer:
        for row, (dataset, segment) in enumerate(SOURCES):
            cars = [car(speed=8.0 + row, steps=range(40 if row == 1 else 91)), car(x=30.0, speed=8.0)]
            drive = replace(straight_road(cars), scenario_id=f"drive-{row}", dataset=dataset, segment=segment)
            writer.add(assemble(drive, SMALL))
    return ScenarioSet.open(path)


def hand_made(data, scenarios, means=None):
    """A table with these scores of scenarios and these means of their valid steps."""
    valid = np.stack([np.asarray(one.record["agent_valid"][:, 0], bool) for one in data])
    means = np.zeros(len(data)) if means is None else np.asarray(means)
    steps = np.where(valid, means[:, None], 0.0)
    ids = tuple(entry["scenario_id"] for entry in data.entries)
    return ScoreTable("kinematic", {}, data.hash, ids, valid, steps, np.asarray(scenarios, float), {})


def test_equal_scenarios_are_told_apart_by_their_steps_and_then_by_the_set(data):
    table = hand_made(data, [0.5, 0.5, 0.9, 0.5, 0.5, 0.1], [0.1, 0.2, 0.0, 0.3, 0.2, 0.9])
    # The second counts its 40 steps only: over all 91 its mean would be below that of the first.
    assert top_rows(table, 6) == [2, 3, 1, 4, 0, 5]
    assert top_rows(table, 2) == [2, 3]
    ranks = [criticality_html(table, row).split("rank ")[1].split(" of ")[0] for row in range(6)]
    assert ranks == ["5", "3", "1", "2", "4", "6"]


def test_a_table_that_was_read_has_the_same_order(data, tmp_path):
    """A file rounds to float32: what is equal there is equal before."""
    near = 0.5 + 1e-12 * np.arange(6)
    table = hand_made(data, near, [0.3, 0.1, 0.2, 0.6, 0.5, 0.4])
    write_scores(table, tmp_path / "scores.npz")
    assert top_rows(table, 6) == top_rows(read_scores(tmp_path / "scores.npz", data), 6) == [3, 4, 5, 0, 2, 1]
    table = hand_made(data, np.full(6, 0.5), near)
    assert top_rows(table, 6) == [0, 1, 2, 3, 4, 5]


def test_the_most_critical_of_each_recording(data):
    """Scenarios of one recording leave room for others; a name of another data set is another one."""
    table = hand_made(data, [0.8, 0.9, 0.1, 0.3, 0.7, 0.6])
    recordings = recordings_of(data.entries)
    assert len(set(recordings)) == 5 and recordings[0] == recordings[1]
    assert top_rows(table, 3) == [1, 0, 4]
    assert top_rows(table, 3, recordings) == [1, 4, 5]
    assert top_rows(table, 6, recordings) == [1, 4, 5, 3, 2]


def test_a_subset_holds_one_scenario_of_each_recording_unless_told_otherwise(data, tmp_path):
    table = hand_made(data, [0.8, 0.9, 0.1, 0.3, 0.7, 0.6])
    for all_windows, rows in ((False, [1, 4, 5]), (True, [1, 0, 4])):
        out = tmp_path / str(all_windows)
        write_top(table, data, 3, out, all_windows=all_windows)
        top = ScenarioSet.open(out)
        assert [entry["scenario_id"] for entry in top.entries] == [f"drive-{row}" for row in rows]
        part = top.manifest["source"]["part_of"]
        assert (part["most_critical"], part["all_windows"]) == (3, all_windows)


def test_too_few_recordings(data, tmp_path, capsys):
    told = (
        "the 6 most critical of 5 recordings, one scenario of each; "
        "ask for 1 to 5, or pass --all-windows to choose among all 6 scenarios"
    )
    with pytest.raises(UsageError, match=told):
        check_top(data, tmp_path / "top", 6)
    check_top(data, tmp_path / "top", 5)
    check_top(data, tmp_path / "top", 6, all_windows=True)
    with pytest.raises(UsageError, match="the 7 most critical of 6 scenarios; ask for 1 to 6"):
        check_top(data, tmp_path / "top", 7, all_windows=True)
    command = ["curate", "uniform", "--data", str(data.path), "--out", str(tmp_path / "scores.npz")]
    assert main([*command, "--export", str(tmp_path / "top"), "6"]) == 2
    assert told in capsys.readouterr().err
    assert main([*command, "--all-windows"]) == 2
    assert "--all-windows without a subset to choose; pass --export TOP N" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main([*command, "--export", str(tmp_path / "top"), "6", "--all-windows"]) == 0
    assert len(ScenarioSet.open(tmp_path / "top")) == 6
