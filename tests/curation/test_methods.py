"""All methods by name, on a small set of the built-in world and on another set."""

from dataclasses import replace
from typing import get_args, get_type_hints

import numpy as np
import pytest

from drivax.cli import main
from drivax.cli.curate import Curate
from drivax.cli.train import Train
from drivax.curation.kinematic import KinematicConfig
from drivax.curation.methods import METHODS, Request, check_current, curate, event_kinds, event_steps
from drivax.curation.scores import Combination, read_scores, top_rows, write_scores, write_top
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Event
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.studies.definition import load_study
from scenes import SMALL, car, straight_road


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Four scenarios with the name of the built-in world; the second has an event, the third ends early."""
    path = tmp_path_factory.mktemp("methods") / "set"
    drives = [
        ([car(speed=10.0)], ()),
        ([car(speed=15.0), car(x=20.0)], (Event(3, 8, 30, (101,)),)),
        ([car(speed=10.0, steps=range(40)), car(x=80.0)], ()),
        ([car(speed=10.0), car(x=30.0, speed=8.0)], ()),
    ]
    with ScenarioWriter(path, SMALL) as writer:
        for row, (cars, events) in enumerate(drives):
            recording = replace(
                straight_road(cars),
                scenario_id=f"drive-{row}",
                dataset="drivax",
                segment=f"recording-{row}",
                events=events,
            )
            writer.add(assemble(recording, SMALL))
    return ScenarioSet.open(path)


@pytest.fixture(scope="module")
def tables(data, tmp_path_factory):
    like = tmp_path_factory.mktemp("tables") / "kinematic.npz"
    write_scores(curate("kinematic", Request(data)), like)
    # These need training, other tables or evaluations, and have their own tests.
    names = [name for name in METHODS if name not in ("ensemble", "mixture", "failures", "novelty", "query")]
    return {
        name: curate(name, Request(data, like=like if name == "random_matched" else None)) for name in names
    }


def test_every_method_scores_every_step_and_round_trips(data, tables, tmp_path):
    for name, table in tables.items():
        assert table.method == name and table.set_hash == data.hash
        assert table.steps.shape == table.valid.shape == (4, 91) and table.scenarios.shape == (4,)
        assert (table.steps[~table.valid] == 0).all()
        assert table.valid.sum(axis=1).tolist() == [91, 91, 40, 91]
        write_scores(table, tmp_path / f"{name}.npz")
        np.testing.assert_allclose(read_scores(tmp_path / f"{name}.npz", data).steps, table.steps, atol=1e-6)


def test_methods_return_their_declared_components(tables):
    for table in tables.values():
        method = METHODS[table.method]
        if table.components:
            weights = method.combination(method.config).weights
            assert set(table.components) == {*weights, *method.extra_components(method.config)}


def test_commands_offer_every_method_and_arm():
    assert all(f"{name}" in (Curate.__doc__ or "") for name in METHODS)
    assert {*get_args(get_args(get_type_hints(Train)["arm"])[0])} == set(load_study("longtail").arms)


def test_scores_of_methods(data, tables):
    assert tables["kinematic"].scenarios.argmax() == 1
    assert sorted(tables["published"].components) == [
        "density", "interaction", "lane_deviation", "off_road", "volatility"
    ]  # fmt: skip
    assert (tables["uniform"].steps == tables["uniform"].valid).all()
    kinematic, control = tables["kinematic"], tables["random_matched"]
    np.testing.assert_allclose(np.sort(control.scenarios), np.sort(kinematic.scenarios), atol=1e-6)
    assert control.config["like"] == "kinematic" and control.config["like_config"]["urgent_s"] == 0.95


def test_own_methods_score_by_dotted_name(data, tmp_path, capsys):
    out = tmp_path / "near.npz"
    call = ["curate", "own_terms:proximity", "--data", str(data.path)]
    assert main([*call, "--out", str(out)]) == 0
    table = read_scores(out, data)
    # Straight ahead: 20 m, then by 15 m/s less in each second, until the cars overlap.
    assert table.method == "own_terms:proximity" and table.components["near"][1, 10] == 0.0
    assert table.components["near"][1, 18] == pytest.approx(1.0 - 8.0 / 20.0, abs=1e-3)
    np.testing.assert_allclose(table.steps[1], table.components["near"][1] * table.valid[1])
    assert table.combination == Combination({"near": 1.0}, "top10")
    out = tmp_path / "speed.npz"
    call = ["curate", "own_terms:Speeds", "--data", str(data.path), "--out", str(out)]
    assert main([*call, "--full_mps", "30", "--weights", "speed", "1"]) == 0
    table = read_scores(out, data)
    np.testing.assert_allclose(table.scenarios, [1 / 3, 0.5, 1 / 3, 1 / 3], atol=1e-4)
    assert table.config["full_mps"] == 30.0 and table.combination == Combination({"speed": 1.0}, "mean")
    capsys.readouterr()
    for name, words in (
        ("own_terms:proximit", "did you mean 'proximity'"),
        ("own_terms:hurry", "takes (before, now, around)"),
        ("kinematics", "unknown method 'kinematics'; did you mean 'kinematic'"),
    ):
        assert main(["curate", name, "--data", str(data.path), "--out", str(tmp_path / "x.npz")]) == 2
        assert words in capsys.readouterr().err
    assert main([*call[:2], "--full_mps", "3", *call[2:], "--overwrite", "--weights", "spee", "1"]) == 2
    assert "unknown component 'spee'" in capsys.readouterr().err


def test_histogram_of_one_set_scores_another(data, tables, tmp_path, capsys):
    other, file = tmp_path / "other", tmp_path / "actions.npz"
    with ScenarioWriter(other, SMALL) as writer:
        writer.add(assemble(straight_road([car(speed=4.0), car(x=30.0, speed=8.0)]), SMALL))
    call = ["curate", "action_rarity", "--actions", str(file), "--out"]
    assert main([*call, str(tmp_path / "own.npz"), "--data", str(data.path), "--temper", "1"]) == 0
    assert capsys.readouterr().out.endswith(f"  wrote {file}\n")
    assert main([*call, str(tmp_path / "again.npz"), "--data", str(data.path)]) == 0
    assert capsys.readouterr().out.endswith(f"  scored by {file}\n")
    own, again = (read_scores(tmp_path / f"{name}.npz", data) for name in ("own", "again"))
    np.testing.assert_array_equal(own.steps, again.steps)
    assert own.config["temper"] == again.config["temper"] == 1.0
    assert main([*call, str(tmp_path / "other.npz"), "--data", str(other)]) == 0
    assert read_scores(tmp_path / "other.npz", ScenarioSet.open(other)).config["actions_of"] == data.hash
    capsys.readouterr()
    for wrong, words in (
        (
            ["action_rarity", "--temper", "0.5"],
            "actions.npz, which exists; leave out --temper 0.5",
        ),
        (["kinematic"], "unknown setting for kinematic; leave out --actions"),
        (
            ["action_rarity_published"],
            "is a histogram of action_rarity; use curate action_rarity, or another file",
        ),
    ):
        out = ["--actions", str(file), "--data", str(other), "--out", str(tmp_path / "x.npz")]
        assert main(["curate", *wrong, *out]) in (1, 2)
        assert words in capsys.readouterr().err


def test_mixtures_combine_the_quantiles_of_tables(data, tables, tmp_path, capsys):
    files = [tmp_path / f"{name}.npz" for name in ("kinematic", "action_rarity")]
    for file in files:
        write_scores(tables[file.stem], file)
    out = tmp_path / "mixture.npz"
    call = ["curate", "mixture", "--data", str(data.path), "--tables", *map(str, files)]
    assert main([*call, "--out", str(out), "--weights", "kinematic", "3", "action_rarity", "1"]) == 0
    table = read_scores(out, data)
    expected = np.zeros(table.steps.shape)
    for name, weight in (("kinematic", 0.75), ("action_rarity", 0.25)):
        steps, valid = tables[name].steps.astype(np.float32), tables[name].valid
        scores = steps[valid]
        quantile = [
            [((scores < x).sum() + (scores <= x).sum()) / 2 / len(scores) for x in row] for row in steps
        ]
        np.testing.assert_allclose(table.components[name], np.array(quantile) * valid, atol=1e-6)
        expected += weight * table.components[name]
    np.testing.assert_allclose(table.steps, expected, atol=1e-6)
    assert main([*call[:-1], "--out", str(tmp_path / "one.npz")]) == 2
    assert "a single table to mix; pass --tables SCORES SCORES" in capsys.readouterr().err
    assert main([*call, str(files[0]), "--out", str(tmp_path / "twice.npz")]) == 0
    assert set(read_scores(tmp_path / "twice.npz", data).components) == {
        "kinematic", "action_rarity", "kinematic_kinematic"
    }  # fmt: skip
    with pytest.raises(UsageError, match="no other method takes it; leave out --tables"):
        curate("kinematic", Request(data, tables=files))


def test_oracle_scores_are_labels(data, tables):
    step = np.arange(91)
    np.testing.assert_array_equal(event_steps(data)[1], (step >= 8) & (step <= 30))
    assert event_kinds(data).tolist() == [0, 3, 0, 0]
    assert tables["oracle"].scenarios.tolist() == [0.0, 1.0, 0.0, 0.0]
    assert tables["oracle"].steps.sum() == 23


def test_oracle_of_conflicts_also_labels_recordings_with_their_tag(tmp_path):
    """The first recording has an event at steps 8 to 30, the second begins with a conflict, the third has neither."""
    events, tags = (Event(3, 8, 30, (101,)),), {"critical": "yes"}
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        for number, changes in enumerate(({"events": events}, {"tags": tags}, {})):
            road = straight_road([car(), car(x=30.0, speed=8.0)])
            recording = replace(road, scenario_id=f"drive-{number}", dataset="drivax", **changes)
            writer.add(assemble(recording, SMALL))
    table = curate("oracle_critical", Request(ScenarioSet.open(tmp_path / "set")))
    assert table.steps.sum(axis=1).tolist() == [23, 91, 0]


def test_oracle_refuses_sets_without_labels(tmp_path):
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        writer.add(assemble(straight_road([car()]), SMALL))
    with pytest.raises(
        DataError, match="only the built-in world has event labels, this set is from test; use"
    ):
        curate("oracle", Request(ScenarioSet.open(tmp_path / "set")))


def test_subset_is_a_set_in_order_of_criticality(data, tables, tmp_path):
    table = tables["kinematic"]
    rows = top_rows(table, 3)
    assert (np.diff(table.scenarios[rows]) <= 0).all() and rows[0] == 1
    write_top(table, data, 3, tmp_path / "top")
    top = ScenarioSet.open(tmp_path / "top")
    top.check()
    assert [entry["scenario_id"] for entry in top.entries] == [f"drive-{row}" for row in rows]
    np.testing.assert_array_equal(top.records(range(3)), data.records(rows))
    assert top.manifest["source"]["part_of"]["method"] == "kinematic"
    assert top_rows(tables["uniform"], 2) == [0, 1]  # equal scores by index
    assert main(["inspect", str(tmp_path / "top")]) == 0


def test_invalid_arguments_are_refused(data, tmp_path):
    for name, like, cure in (
        ("random_matched", None, "pass --like SCORES"),
        ("uniform", tmp_path / "x.npz", "leave out --like"),
    ):
        with pytest.raises(UsageError, match=f"random_matched needs --like.*; {cure}"):
            curate(name, Request(data, like=like))
    with pytest.raises(UsageError, match="unknown method 'kinematics'; did you mean 'kinematic'"):
        curate("kinematics", Request(data))
    with pytest.raises(DataError, match="score table not found"):
        curate("random_matched", Request(data, like=tmp_path / "none.npz"))


def test_settings_of_a_method(data, tables, tmp_path, capsys):
    table = curate("kinematic", Request(data, config=KinematicConfig(urgent_s=2.0)))
    assert table.config["urgent_s"] == 2.0
    assert table.components["urgency"].max() >= tables["kinematic"].components["urgency"].max()
    with pytest.raises(UsageError, match="uniform has no settings of type KinematicConfig; remove them"):
        curate("uniform", Request(data, config=KinematicConfig()))
    out = tmp_path / "scores.npz"
    assert main(["curate", "kinematic", "--data", str(data.path), "--out", str(out), "--urgent_s", "2"]) == 0
    np.testing.assert_allclose(read_scores(out, data).steps, table.steps, atol=1e-6)
    assert main(["curate", "oracle", "--data", str(data.path), "--out", str(out), "--urgent_s", "2"]) == 2
    assert "unknown setting for oracle; leave out --urgent_s 2" in capsys.readouterr().err


def test_weights_and_aggregators_can_be_changed(data, tmp_path):
    """Aggregators of components without weight have no effect."""
    out = tmp_path / "scores.npz"
    call = [
        "curate",
        "published",
        "--data",
        str(data.path),
        "--out",
        str(out),
        "--weights",
        "volatility",
        "1",
    ]
    assert main(call) == 0
    result = read_scores(out, data)
    assert (
        result.combination.weights == {"volatility": 1.0} and result.combination.scenario["density"] == "mean"
    )
    assert main([*call, "--overwrite", "--scenario", "volatility", "max"]) == 0
    top = np.where(result.valid, result.components["volatility"], 0.0).max(axis=1)
    np.testing.assert_allclose(read_scores(out, data).scenarios, top, rtol=1e-6)


def test_tables_with_other_settings_are_refused(data, tables, tmp_path):
    for name in ("kinematic", "action_rarity", "published", "uniform", "random_matched"):
        write_scores(tables[name], tmp_path / f"{name}.npz")
        check_current(read_scores(tmp_path / f"{name}.npz", data))
    table = tables["kinematic"]
    with pytest.raises(DataError, match=r"have urgent_s 0\.95, not 2\.0; score again"):
        check_current(table, KinematicConfig(urgent_s=2.0))
    for other in (replace(table.combination, scenario="max"), Combination({"urgency": 1.0}, "top10")):
        with pytest.raises(DataError, match="scores of 'kinematic' have combination"):
            check_current(table.recombine(other))
