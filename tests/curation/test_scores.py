"""The table of scores: what comes back, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from drivax.cli import main
from drivax.curation.scores import ScoreTable, read_scores, write_scores
from drivax.errors import DataError, UsageError
from drivax.scenario.assemble import assemble
from drivax.scenario.schema import Capacity
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from scenes import car, straight_road


def write_set(path, speeds):
    with ScenarioWriter(path, Capacity()) as writer:
        for row, speed in enumerate(speeds):
            recording = straight_road([car(speed=speed), car(x=40.0)])
            writer.add(assemble(replace(recording, scenario_id=f"drive-{row}")))
    return ScenarioSet.open(path)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("scores") / "set", (6.0, 12.0))


@pytest.fixture
def table(data):
    steps = np.linspace(0, 1, 2 * 91, dtype=np.float32).reshape(2, 91)
    return ScoreTable("kinematic", {"urgent_s": 0.95}, data.hash, ("drive-0", "drive-1"), steps)


def test_what_is_written_comes_back(data, table, tmp_path):
    out = tmp_path / "deep" / "scores"
    write_scores(table, out)
    found = read_scores(out, data)
    assert (found.method, dict(found.config), found.set_hash, found.scenario_ids) == (
        "kinematic", {"urgent_s": 0.95}, data.hash, ("drive-0", "drive-1"),
    )  # fmt: skip
    np.testing.assert_array_equal(found.steps, table.steps)
    np.testing.assert_array_equal(found.scenarios, table.steps[:, -1])
    with np.load(out) as stored:
        assert json.loads(str(stored["header"]))["method"] == "kinematic"
        np.testing.assert_array_equal(stored["scenario_score"], table.steps.max(axis=1))
    assert [path.name for path in out.parent.iterdir()] == ["scores"]


def test_a_missing_table(data, tmp_path):
    with pytest.raises(DataError) as error:
        read_scores(tmp_path / "none.npz", data)
    assert "none.npz: there are no scores; make them with `drivax curate METHOD" in str(error.value)


def test_a_stale_table(data, table, tmp_path):
    write_scores(replace(table, set_hash="0" * 64), tmp_path / "old.npz")
    with pytest.raises(DataError) as error:
        read_scores(tmp_path / "old.npz", data)
    assert "is of other data (hash 000000000000" in str(error.value)
    assert str(error.value).endswith("; run `drivax curate` again")


def test_damaged_tables(data, table, tmp_path):
    file = tmp_path / "scores.npz"
    write_scores(table, file)
    whole = file.read_bytes()
    half = whole[: len(whole) // 2]
    flipped = bytearray(whole)
    flipped[whole.index(b"step_score") + 60] ^= 0xFF
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.save(tmp_path / "array.npy", np.zeros(3))
    others = [(tmp_path / name).read_bytes() for name in ("other.npz", "array.npy")]
    for content in (b"", b"text", half, bytes(flipped), *others):
        file.write_bytes(content)
        with pytest.raises(DataError, match=r"no table of scores, or damaged .*; run `drivax curate` again"):
            read_scores(file, data)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scenario_ids": ("drive-1", "drive-0")}, "does not score every scenario"),
        ({"steps": np.zeros((2, 90), np.float32)}, "does not score every scenario and step"),
    ],
)
def test_tables_that_do_not_fit(data, table, tmp_path, change, words):
    write_scores(replace(table, **change), tmp_path / "scores.npz")
    with pytest.raises(DataError, match=words):
        read_scores(tmp_path / "scores.npz", data)


@pytest.mark.parametrize("value", [np.nan, -0.1, 1.1])
def test_a_missing_score_is_an_error_and_leaves_no_file(table, tmp_path, value):
    table.steps[1, 7] = value
    with pytest.raises(DataError, match=r"record drive-1: has a score outside \[0, 1\]"):
        write_scores(table, tmp_path / "scores.npz")
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten_unasked(data, table, tmp_path):
    file = tmp_path / "scores.npz"
    write_scores(table, file)
    with pytest.raises(UsageError, match="exists already; choose another name or pass --overwrite"):
        write_scores(table, file)
    write_scores(replace(table, method="other"), file, overwrite=True)
    assert read_scores(file, data).method == "other"
    with pytest.raises(UsageError, match="is a folder"):
        write_scores(table, tmp_path, overwrite=True)


def test_a_failure_leaves_the_old_table(table, tmp_path, monkeypatch):
    file = tmp_path / "scores.npz"
    write_scores(table, file)
    before = file.read_bytes()
    monkeypatch.setattr(np, "savez_compressed", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_scores(table, file, overwrite=True)
    assert file.read_bytes() == before and [path.name for path in tmp_path.iterdir()] == ["scores.npz"]


def test_the_command(data, tmp_path, capsys):
    out = tmp_path / "scores.npz"
    assert main(["curate", "kinematic", "--data", str(data.path), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    found = read_scores(out, data)
    assert found.scenarios[1] > 0.9 and "2 scenarios, kinematic criticality" in said
    assert main(["curate", "kinematic", "--data", str(data.path), "--out", str(out)]) == 2
    assert main(["curate", "kinematic", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "x")]) == 1
    assert main(["curate", "guesswork", "--data", str(data.path), "--out", str(tmp_path / "x")]) == 2
    assert not (tmp_path / "x").exists()
