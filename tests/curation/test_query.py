"""Queries: expressions against NumPy, quantities in hand-made scenes, and nothing executed."""

from dataclasses import replace

import numpy as np
import pytest

from drivax.cli import main
from drivax.curation.logged import score_bank
from drivax.curation.query import QUANTITIES, Quantities, QueryConfig, evaluate
from drivax.curation.scores import read_scores
from drivax.errors import UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from scenes import SMALL, bank_of, car, straight_road

RNG = np.random.default_rng(0)
VALUES = {name: RNG.normal(size=(3, 6)) * 10 for name in QUANTITIES}


def cutting_in():
    """A car 20 m ahead in the next lane at the same speed of 10 m/s, which changes to ego's lane from step 30 to 50."""
    other = car(x=20.0, y=3.7, speed=10.0)
    y = np.interp(np.arange(91), [30, 50], [3.7, 0.0])
    return [car(speed=10.0), other | {"xy": np.stack([other["xy"][:, 0], y], -1)}]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("speed > 10", lambda v: v["speed"] > 10),
        ("cut_in < 20 and speed > 10", lambda v: (v["cut_in"] < 20) & (v["speed"] > 10)),
        ("not (gap < 3 or ttc <= 2) ", lambda v: ~((v["gap"] < 3) | (v["ttc"] <= 2))),
        ("1 < speed <= 5.5", lambda v: (v["speed"] > 1) & (v["speed"] <= 5.5)),
        ("gap / speed < -closing * 2 + 1", lambda v: v["gap"] / v["speed"] < -v["closing"] * 2 + 1),
        ("agents != 4", lambda v: v["agents"] != 4),
    ],
)
def test_expressions_against_numpy(text, expected):
    np.testing.assert_array_equal(evaluate(text, VALUES), expected(VALUES))


@pytest.mark.parametrize(
    "text",
    [
        "speed", "speed +", "speed > 'a'", "__import__('os').system('true') > 1", "speed.real > 1", "speed[0] > 1",
        "(lambda: 1)() > 0", "speed ** 2 > 1", "speed > True", "(speed > 1) + 1 > 0", "speed and gap > 1", "[1] > 0",
        "speed is 1", "(x := 3) > 1", "speed > 1 if gap else 2", "1" * 1001, "(" * 500 + "1" + ")" * 500 + "> 0", "",
    ],
)  # fmt: skip
def test_other_expressions_are_refused(text):
    with pytest.raises(UsageError, match=r"is not a query|is a number"):
        evaluate(text, VALUES)


def test_unknown_quantities_are_named():
    with pytest.raises(UsageError, match="unknown quantity 'sped'; did you mean 'speed'"):
        QueryConfig("sped > 1")
    with pytest.raises(UsageError, match="for_s is -1"):
        QueryConfig("speed > 1", -1.0)


def test_quantities_of_a_cut_in():
    values = {
        name: np.asarray(x)[0]
        for name, x in score_bank(Quantities(), bank_of(straight_road(cutting_in()))).items()
    }
    assert set(values) == set(QUANTITIES)
    np.testing.assert_allclose(values["speed"], 10.0, atol=1e-3)
    # Boxes of 4.8 x 2 m: on the path while the centre is less than 2 m to the side.
    enters = int(np.argmax(np.interp(np.arange(91), [30, 50], [3.7, 0.0]) < 2.0))
    on_path = np.isfinite(values["gap"])
    np.testing.assert_array_equal(on_path[:85], (np.arange(91) >= enters)[:85])
    np.testing.assert_allclose(values["gap"][on_path][:20], 20.0 - 4.8, atol=0.05)
    np.testing.assert_allclose(values["closing"][on_path][:20], 0.0, atol=0.05)
    np.testing.assert_array_equal(
        np.flatnonzero(np.isfinite(values["cut_in"])), np.arange(enters, enters + 10)
    )
    assert (values["agents"] == 2).all() and (values["ttc"][:30] == 5.0).all()
    assert values["nearest"][0] == pytest.approx(np.hypot(15.2, 1.7), abs=0.05)


def test_conditions_must_hold_for_a_time():
    holds = np.zeros((1, 20))
    holds[0, [2, 3, 4, 8, 9, 12]] = 1.0
    quantities, valid = dict.fromkeys(QUANTITIES, holds), np.ones((1, 20), bool)
    for for_s, steps in (
        (0.0, [2, 3, 4, 8, 9, 12]),
        (0.2, [2, 3, 4, 8, 9]),
        (0.3, [2, 3, 4]),
        (0.4, []),
        (9.0, []),
    ):
        matches = QueryConfig("speed > 0", for_s).matches(quantities, valid)
        assert np.flatnonzero(matches[0]).tolist() == steps
    valid[0, 3] = False
    assert np.flatnonzero(QueryConfig("speed > 0", 0.2).matches(quantities, valid)[0]).tolist() == [8, 9]


def test_command_finds_and_exports_cut_ins(tmp_path, capsys):
    path, scores, top = tmp_path / "set", tmp_path / "scores.npz", tmp_path / "top"
    with ScenarioWriter(path, SMALL) as writer:
        for row, cars in enumerate(
            ([car(speed=10.0)], cutting_in(), [car(speed=10.0), car(x=15.0, speed=10.0)])
        ):
            recording = replace(straight_road(cars), scenario_id=f"s{row}", segment=f"r{row}")
            writer.add(assemble(recording, SMALL))
    call = ["curate", "query", "--data", str(path), "--out", str(scores)]
    query = ["--where", "cut_in < 20 and speed > 9", "--for_s", "0.5", "--export", str(top), "1"]
    assert main([*call, *query]) == 0
    table = read_scores(scores, ScenarioSet.open(path))
    np.testing.assert_array_equal(table.scenarios, [0.0, 1.0, 0.0])
    assert table.steps[1].sum() == 10 and table.config["where"] == "cut_in < 20 and speed > 9"
    assert [entry["scenario_id"] for entry in ScenarioSet.open(top).entries] == ["s1"]
    capsys.readouterr()
    assert main([*call, "--overwrite"]) == 2
    assert 'no query; pass --where "cut_in < 20 and speed > 10"' in capsys.readouterr().err
