"""Score tables: round trips and refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest

from drivax.cli import main
from drivax.curation import scores
from drivax.curation.methods import Request, curate
from drivax.curation.scores import Combination, ScoreTable, read_scores, write_scores
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Capacity
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.seal import allow_edited, edited_files
from scenes import car, straight_road


def write_set(path, speeds):
    with ScenarioWriter(path, Capacity()) as writer:
        for row, speed in enumerate(speeds):
            recording = straight_road([car(speed=speed), car(x=40.0)])
            drive = replace(recording, scenario_id=f"drive-{row}", segment=f"recording-{row}")
            writer.add(assemble(drive))
    return ScenarioSet.open(path)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("scores") / "set", (2.0, 12.0))


PARTS = Combination({"urgency": 0.5, "braking": 0.5})


@pytest.fixture
def table(data):
    rng = np.random.default_rng(0)
    parts = {name: rng.random((2, 91)).astype(np.float32) for name in ("urgency", "braking")}
    valid = np.ones((2, 91), bool)
    valid[1, 80:] = False
    blank = np.zeros((2, 91))
    return ScoreTable(
        "kinematic", {"urgent_s": 0.95}, data.hash, ("drive-0", "drive-1"), valid, blank, blank[:, 0], parts
    ).recombine(PARTS)


def test_tables_round_trip(data, table, tmp_path):
    out = tmp_path / "deep" / "scores"
    write_scores(table, out)
    result = read_scores(out, data)
    config = {
        "urgent_s": 0.95,
        "combination": {"weights": {"urgency": 0.5, "braking": 0.5}, "scenario": "max"},
    }
    assert (result.method, dict(result.config), result.set_hash, result.scenario_ids) == (
        "kinematic", config, data.hash, ("drive-0", "drive-1"),
    )  # fmt: skip
    np.testing.assert_array_equal(result.valid, table.valid)
    np.testing.assert_allclose(result.steps, table.steps, rtol=1e-6)
    np.testing.assert_allclose(result.scenarios, table.steps.max(axis=1), rtol=1e-6)
    assert sorted(result.components) == ["braking", "urgency"]
    for name, part in table.components.items():
        np.testing.assert_array_equal(result.components[name], part)
    with np.load(out) as stored:
        assert json.loads(str(stored["header"]))["method"] == "kinematic"
        np.testing.assert_allclose(stored["scenario_score"], table.steps.max(axis=1), rtol=1e-6)
    assert [path.name for path in out.parent.iterdir()] == ["scores"]


def test_components_can_be_combined_again(data, table, tmp_path):
    write_scores(table, tmp_path / "scores.npz")
    result = read_scores(tmp_path / "scores.npz", data)
    again = result.recombine(Combination({"braking": 0.25, "urgency": 0.75}, "mean"))
    parts = 0.25 * result.components["braking"] + 0.75 * result.components["urgency"]
    expected = np.where(result.valid, parts, 0.0)
    np.testing.assert_allclose(again.steps, expected, rtol=1e-6)
    np.testing.assert_allclose(again.scenarios, [expected[0].mean(), expected[1, :80].mean()], rtol=1e-6)
    assert again.config["combination"]["weights"] == {"braking": 0.25, "urgency": 0.75}
    assert again.config["combination"]["scenario"] == "mean"
    with pytest.raises(UsageError, match="unknown component 'brakes'; did you mean 'braking'"):
        result.recombine(Combination({"brakes": 1.0}))


def test_older_versions_are_refused(data, table, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(scores, "SCORES_VERSION", 1)
        write_scores(table, tmp_path / "old.npz")
    with pytest.raises(DataError, match="version 1, this drivax reads 3; run `drivax curate` again"):
        read_scores(tmp_path / "old.npz", data)


@pytest.fixture(scope="module")
def lively(tmp_path_factory):
    """Ego accelerates, brakes, swerves and is unobserved for a second, with a car ahead and an oncoming car."""
    t = (np.arange(91) - 10) * 0.1
    speed, swerve = 9.0 + 3.0 * np.sin(0.9 * t), 0.8 * np.sin(0.7 * t)
    along = np.cumsum(speed) * 0.1
    heading = np.arctan2(0.56 * np.cos(0.7 * t), speed)
    ego = car() | {
        "xy": np.stack([along - along[10], swerve], -1),
        "heading": heading,
        "velocity": speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1),
        "valid": ~np.isin(np.arange(91), range(50, 60)),
    }
    path = tmp_path_factory.mktemp("lively") / "set"
    with ScenarioWriter(path, Capacity()) as writer:
        others = [car(x=25.0, speed=7.0), car(x=90.0, y=3.7, heading=np.pi, speed=10.0)]
        writer.add(assemble(straight_road([ego, *others])))
    return ScenarioSet.open(path)


#: By method that needs no training: the scores of the scenario ``lively``, and of every twelfth step.
FROZEN = {
    "kinematic": [0.2344, 0.0837, 0.0270, 0.1151, 0.1369, 0.0317, 0.0829, 0.0876, 0.1839],
    "published": [0.5311, 0.2493, 0.1308, 0.6747, 0.6327, 0.2418, 0.5099, 0.5612, 0.3822],
    "action_rarity": [0.0856, 0.0484, 0.0356, 0.0728, 0.0767, 0.0, 0.0771, 0.0399, 0.0338],
    "action_rarity_published": [0.1771, 0.0936, 0.0323, 0.1771, 0.1771, 0.0, 0.1214, 0.1214, 0.0434],
}


@pytest.mark.parametrize("method", ["kinematic", "published", "action_rarity", "action_rarity_published"])
def test_scores_equal_stored_values_of_this_version(lively, method):
    """If these values change, increase SCORES_VERSION, so that older tables are refused."""
    result = curate(method, Request(lively))
    assert scores.SCORES_VERSION == 3
    np.testing.assert_allclose([*result.scenarios, *result.steps[0, ::12]], FROZEN[method], atol=5e-4)


def test_missing_table_is_refused(data, tmp_path):
    with pytest.raises(DataError) as error:
        read_scores(tmp_path / "none.npz", data)
    assert "none.npz: score table not found; write it with `drivax curate METHOD" in str(error.value)


def test_table_of_other_data_is_refused(data, table, tmp_path):
    write_scores(replace(table, set_hash="0" * 64), tmp_path / "old.npz")
    with pytest.raises(DataError) as error:
        read_scores(tmp_path / "old.npz", data)
    assert "scores belong to another set (hash 000000000000" in str(error.value)
    assert str(error.value).endswith("; run `drivax curate` again")


def test_damaged_tables_are_refused(data, table, tmp_path):
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
        with pytest.raises(DataError, match=r"or damaged \(.*; run `drivax curate` again"):
            read_scores(file, data)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("scenario_id", np.array(["drive-1", "drive-0"])),
        ("step_score", np.zeros((2, 90), np.float32)),
        ("valid", np.ones((2, 90), bool)),
        ("scenario_score", np.zeros(3, np.float32)),
        ("component_urgency", np.zeros((2, 90), np.float32)),
    ],
)
def test_tables_of_other_shapes_are_refused(data, table, tmp_path, name, wrong):
    file = tmp_path / "scores.npz"
    write_scores(table, file)
    with np.load(file) as stored:
        arrays = dict(stored) | {name: wrong}
    np.savez(file, allow_pickle=False, **arrays)
    with pytest.raises(DataError, match="does not score every scenario and step of its set"):
        read_scores(file, data)


def test_edited_tables_need_permission_and_are_noted(data, table, tmp_path):
    file = tmp_path / "scores.npz"
    write_scores(table, file)
    with np.load(file) as stored:
        arrays = dict(stored)
    np.savez(file, allow_pickle=False, **arrays)
    assert read_scores(file, data).method == "kinematic"  # written again, with the same content
    arrays["scenario_score"] = arrays["scenario_score"][::-1]
    np.savez(file, allow_pickle=False, **arrays)
    with pytest.raises(DataError, match=r"changed since drivax wrote it; .* --edited"):
        read_scores(file, data)
    with allow_edited():
        edited = read_scores(file, data)
        assert edited_files() == [str(file)]
        write_scores(edited, tmp_path / "next.npz")
    with allow_edited(False):
        read_scores(tmp_path / "next.npz", data)
        assert edited_files() == [str(file)]
    header = json.loads(str(arrays["header"]))
    del header["sha256"]  # as tables of earlier versions
    np.savez(file, allow_pickle=False, **arrays | {"header": np.array(json.dumps(header))})
    assert read_scores(file, data).method == "kinematic"
    header["edited"] = "abc"
    np.savez(file, allow_pickle=False, **arrays | {"header": np.array(json.dumps(header))})
    with pytest.raises(DataError, match="edited is not a list"):
        read_scores(file, data)
    header["edited"] = ["a" * (1 << 20)]
    np.savez(file, allow_pickle=False, **arrays | {"header": np.array(json.dumps(header))})
    with pytest.raises(DataError, match=r"a header of 1,0\d\d,\d\d\d characters"):
        read_scores(file, data)


@pytest.mark.parametrize("value", [np.nan, -0.1, 1.1])
@pytest.mark.parametrize("which", ["steps", "scenarios", "components"])
def test_scores_outside_the_range_are_not_written(table, tmp_path, which, value):
    part = table.components["urgency"] if which == "components" else getattr(table, which)
    part[1, ...] = value
    with pytest.raises(DataError, match=r"record drive-1: has a score outside \[0, 1\]"):
        write_scores(table, tmp_path / "scores.npz")
    assert not list(tmp_path.iterdir())


def test_existing_table_needs_overwrite(data, table, tmp_path):
    file = tmp_path / "scores.npz"
    write_scores(table, file)
    with pytest.raises(UsageError, match="output file already exists; choose another or pass --overwrite"):
        write_scores(table, file)
    write_scores(replace(table, method="other"), file, overwrite=True)
    assert read_scores(file, data).method == "other"
    with pytest.raises(UsageError, match="output is a folder"):
        write_scores(table, tmp_path, overwrite=True)


def test_failed_write_keeps_the_old_table(table, tmp_path, monkeypatch):
    file = tmp_path / "scores.npz"
    write_scores(table, file)
    before = file.read_bytes()
    monkeypatch.setattr(np, "savez_compressed", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_scores(table, file, overwrite=True)
    assert file.read_bytes() == before and [path.name for path in tmp_path.iterdir()] == ["scores.npz"]


def test_command_writes_scores(data, tmp_path, capsys):
    out, top = tmp_path / "scores.npz", tmp_path / "top"
    command = ["curate", "kinematic", "--data", str(data.path)]
    assert main([*command, "--out", str(out), "--export", str(top), "1"]) == 0
    printed = capsys.readouterr().out
    result = read_scores(out, data)
    assert result.scenarios[1] > result.scenarios[0] and result.steps[1].max() > 0.25
    for words in ("2 scenarios, kinematic", "effective sample", "the 1 most critical"):
        assert words in printed
    assert max(map(len, printed.replace(str(tmp_path), "").splitlines())) < 100
    assert [entry["scenario_id"] for entry in ScenarioSet.open(top).entries] == ["drive-1"]
    # Other weights and another aggregator, without scoring again.
    recombine = [*command, "--out", str(tmp_path / "recombined.npz"), "--again", str(out)]
    assert main([*recombine, "--weights", "urgency", "0.5", "density", "0.25", "--scenario", "max"]) == 0
    other = read_scores(tmp_path / "recombined.npz", data)
    by_hand = (2 * result.components["urgency"] + result.components["density"]) / 3
    np.testing.assert_allclose(other.steps, np.where(result.valid, by_hand, 0.0), rtol=1e-6)
    np.testing.assert_array_equal(other.scenarios, other.steps.max(axis=1))
    assert other.combination == Combination({"urgency": 0.5, "density": 0.25}, "max")
    # And one aggregator for each component.
    weights, apart = ["--weights", "urgency", "0.5", "braking", "0.25"], ["urgency", "max", "braking", "mean"]
    assert main([*recombine, "--overwrite", *weights, "--scenario", *apart]) == 0
    other = read_scores(tmp_path / "recombined.npz", data)
    urgency, braking = (
        np.where(result.valid, result.components[name], 0.0) for name in ("urgency", "braking")
    )
    by_hand = (2 * urgency.max(axis=1) + braking.sum(axis=1) / result.valid.sum(axis=1)) / 3
    np.testing.assert_allclose(other.scenarios, by_hand, rtol=1e-5)
    assert other.combination.scenario == {"urgency": "max", "braking": "mean"}
    capsys.readouterr()
    for wrong, words in (
        (["--weights", "urgencies", "1"], "unknown component 'urgencies'; did you mean 'urgency'"),
        (["--scenario", "p101"], "unknown aggregator 'p101'"),
        (
            [*weights, "--scenario", "urgency", "max"],
            "missing aggregator for 'braking'; name an aggregator for each comp",
        ),
        ([*weights, "--scenario", *apart, "densty", "max"], "'densty'; did you mean 'density'"),
        ([*weights, "--scenario", "urgency", "max", "braking", "most"], "unknown aggregator 'most'"),
        (["--scenario", "urgency=max", "braking=p95"], "unknown aggregator 'braking=p95'"),
    ):
        assert main([*recombine, "--overwrite", *wrong]) == 2
        assert words in capsys.readouterr().err
    # Without --again, such errors are found before training or scoring.
    begin = ["--data", str(data.path), "--out", str(tmp_path / "x")]
    mixture = ["--cloning.loss", "likelihood", "--cloning.network.distribution", "mixture"]
    for wrong, words in (
        (["kinematic", "--weights", "urgency", "-1"], "the weight of 'urgency' is -1.0; use 0 or more"),
        (["kinematic", "--scenario", "p101"], "unknown aggregator 'p101'"),
        (["kinematic", "--scenario", "urgency", "max"], "missing aggregator for 'braking'"),
        (["ensemble", "--weights", "actoin_0", "1"], "unknown component 'actoin_0'; did you mean 'action_0'"),
        (["ensemble", *mixture, "--weights", "action_0", "1"], "unknown component 'action_0'"),
    ):
        assert main(["curate", *wrong[:1], *begin, *wrong[1:]]) == 2
        messages = capsys.readouterr().err
        assert words in messages and "scor" not in messages.split(words)[0]
    assert main(["curate", "published", *recombine[2:], "--overwrite"]) == 2
    assert "is a table of kinematic; use curate kinematic" in capsys.readouterr().err
    for ignored in (["--seed", "1"], ["--like", str(out)]):
        assert main([*recombine, "--overwrite", *ignored]) == 2
        assert f"which is not scored again; leave out {ignored[0]}" in capsys.readouterr().err
    assert main([*command, "--out", str(tmp_path / "x"), "--seed", "1"]) == 2
    assert "unknown setting for kinematic; leave out --seed" in capsys.readouterr().err
    control = ["curate", "random_matched", *command[2:], "--like", str(out), "--out", str(tmp_path / "x")]
    assert main([*control, "--scenario", "max"]) == 2
    assert "which have no components; pass --weights and --scenario to the method" in capsys.readouterr().err
    assert main([*command, "--out", str(out)]) == 2
    assert main(["curate", "kinematic", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "x")]) == 1
    assert main(["curate", "guesswork", "--data", str(data.path), "--out", str(tmp_path / "x")]) == 2
    capsys.readouterr()
    for out_of_range in ("0", "3"):
        assert (
            main([*command, "--out", str(tmp_path / "x"), "--export", str(tmp_path / "y"), out_of_range]) == 2
        )
        assert "of 2 scenarios; ask for 1 to 2" in capsys.readouterr().err
    for taken, words in ((data.path, "is the input set"), (top, "already exists")):
        assert main([*command, "--out", str(tmp_path / "x"), "--export", str(taken), "1"]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
