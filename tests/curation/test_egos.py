"""Scores of further egos: those of the same vehicles as recorded egos, in tables, subsets and weights."""

import json
from dataclasses import replace

import numpy as np
import pytest

from drivax.cli import main
from drivax.curation.kinematic import KinematicConfig, PublishedConfig
from drivax.curation.logged import score_steps, valid_steps
from drivax.curation.methods import Request, curate
from drivax.curation.rarity import ExpertActions
from drivax.curation.scores import ScoreTable, aggregate, read_scores, top_rows, write_scores, write_top
from drivax.curation.weights import WeightConfig, draw_statistics, permute_scores, sampling_weights
from drivax.errors import DataError, UsageError
from drivax.report.pages.viewer import criticality_html
from drivax.scenario.schema import CAPACITIES
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.synthetic.world import generate_recording
from scenes import car, further_egos, straight_road

EGOS = 4
SMALL = replace(CAPACITIES["default"], name="small", agents=40, parked=24)


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    """A set whose scenarios have 4, 4 and 1 egos, that of the 6 further ones as recorded egos, and their rows."""
    recordings = [
        generate_recording(0, 8),
        straight_road(
            [
                car(0, 0, 0, 10),
                car(-25, -0.5, 0, 13),
                car(10, 3.7, 0, 12, steps=range(6, 41)),
                car(-38, 0, 0, 9),
            ]
        ),
        straight_road([car(0, 0, 0, 10), car(30, 0)]),
    ]
    recordings = [replace(each, scenario_id=f"drive-{row}") for row, each in enumerate(recordings)]
    scenarios, alone, places = further_egos(recordings, SMALL, EGOS)
    folder, sets = tmp_path_factory.mktemp("egos"), []
    for name, capacity, members in (("egos", SMALL.with_egos(EGOS), scenarios), ("alone", SMALL, alone)):
        with ScenarioWriter(folder / name, capacity) as writer:
            for scenario in members:
                writer.add(scenario)
        sets.append(ScenarioSet.open(folder / name))
    return *sets, places @ [EGOS, 1]


@pytest.fixture(scope="module")
def table(worlds):
    return curate("kinematic", Request(worlds[0], egos="moving"))


@pytest.mark.parametrize("score", [KinematicConfig(), PublishedConfig(), ExpertActions()])
def test_scores_are_those_of_a_recorded_ego(worlds, score):
    data, alone, rows = worlds
    valid, own_valid = valid_steps(data, EGOS), valid_steps(alone)
    assert valid.any(axis=1).reshape(-1, EGOS).sum(axis=1).tolist() == [4, 4, 1]
    values, own_values = score_steps(data, score, egos=EGOS), score_steps(alone, score)
    recorded = score_steps(data, score)
    for name, own in own_values.items():
        np.testing.assert_array_equal(values[name][::EGOS], recorded[name], err_msg=name)
        for row, own_steps, observed in zip(rows, own, own_valid, strict=True):
            steps = np.flatnonzero(valid[row])
            last = data[row // EGOS].record["ego_last_step"][row % EGOS - 1]
            assert observed[steps].all() and steps[-1] <= last <= 90
            # Filters and actions look ahead, beyond the end of a log that leaves the map.
            steps = steps if last == 90 else steps[:-15]
            # In the built-in world, distant agents are those near the recorded ego.
            if row > EGOS or name not in ("density", "interaction"):
                # Routes follow lanes, logged paths sway.
                tolerance = 0.04 if row < EGOS and name == "braking" else 0.005
                np.testing.assert_allclose(
                    values[name][row, steps], own_steps[steps], atol=tolerance, err_msg=name
                )
    if isinstance(score, KinematicConfig):
        # More than constants are compared; no paths cross here.
        assert all(np.ptp(own) > 0.05 for name, own in own_values.items() if name != "encroachment")


def test_a_scenario_is_as_critical_as_its_most_critical_ego(worlds, table):
    data = worlds[0]
    recorded, valid = curate("kinematic", Request(data)), valid_steps(data, EGOS)
    assert table.egos == EGOS and table.steps.shape == (3 * EGOS, 91)
    np.testing.assert_array_equal(table.valid, valid)
    assert not table.steps[~valid].any()
    np.testing.assert_array_equal(table.steps[::EGOS], recorded.steps)
    np.testing.assert_allclose(
        table.scenarios, aggregate(table.steps, valid, "top10").reshape(3, EGOS).max(axis=1)
    )
    assert table.scenarios[1] > recorded.scenarios[1] + 0.1  # the car behind approaches at 3 m/s
    again = table.recombine(
        replace(table.combination, scenario=dict.fromkeys(table.combination.weights, "p95"))
    )
    assert again.scenarios.shape == (3,) and again.scenarios[1] > recorded.scenarios[1]


def test_tables_of_all_egos_round_trip(worlds, table, tmp_path):
    data, alone, _ = worlds
    write_scores(table, tmp_path / "all.npz")
    result = read_scores(tmp_path / "all.npz", data)
    assert result.egos == EGOS
    for name in ("valid", "steps", "scenarios"):
        np.testing.assert_allclose(getattr(result, name), getattr(table, name), rtol=1e-6)
    with pytest.raises(DataError, match="does not score every scenario and step of its set"):
        write_scores(replace(table, egos=1), tmp_path / "one.npz")
        read_scores(tmp_path / "one.npz", data)
    with np.load(tmp_path / "all.npz") as stored:
        arrays = dict(stored)
    header = json.loads(str(arrays.pop("header")))
    del header["sha256"]
    for egos in (3, 4.0, "4", None, [4]):
        text = np.array(json.dumps({**header, "egos": egos}))
        np.savez_compressed(tmp_path / "wrong.npz", allow_pickle=False, header=text, **arrays)
        with pytest.raises(DataError, match=r"not a score table, or damaged .* egos per scenario"):
            read_scores(tmp_path / "wrong.npz", data)
    with pytest.raises(UsageError, match=r"only the recorded ego of each scenario has a route; .* --egos 8"):
        curate("kinematic", Request(alone, egos="moving"))
    bad = table.steps.copy()
    bad[2 * EGOS + 3, 5] = 2.0
    with pytest.raises(DataError, match=r"drive-2.*has a score outside \[0, 1\]"):
        write_scores(replace(table, steps=bad), tmp_path / "bad.npz")


def test_the_most_critical_scenarios_keep_the_scores_of_all_egos(worlds, table, tmp_path):
    data = worlds[0]
    rows = top_rows(table, 2)
    assert rows == np.argsort(-table.scenarios)[:2].tolist() and rows != [0, 1]
    write_top(table, data, 2, tmp_path / "top", all_windows=True)
    top = read_scores(tmp_path / "top/scores.npz", ScenarioSet.open(tmp_path / "top"))
    assert top.egos == EGOS and top.scenario_ids == tuple(f"drive-{row}" for row in rows)
    np.testing.assert_allclose(
        top.steps.reshape(2, EGOS, -1), table.steps.reshape(3, EGOS, -1)[rows], rtol=1e-6
    )
    # Players show the recorded ego.
    parts = {name: part[::EGOS] for name, part in table.components.items()}
    valid, steps = table.valid[::EGOS], table.steps[::EGOS]
    recorded = replace(table, egos=1, valid=valid, steps=steps, components=parts)
    assert criticality_html(table, 1) == criticality_html(recorded, 1)


def hand_made(scores, scenarios, egos=1):
    """A table of two scenarios whose logs have constant scores, over four steps of which three are drawable."""
    steps = np.repeat(np.asarray(scores, float)[:, None], 4, axis=1)
    return ScoreTable(
        "made", {}, "hash", ("a", "b"), steps > 0, steps, np.asarray(scenarios, float), {}, egos
    )


PLAIN = WeightConfig(normalise="none", temperature=1.0, most=float("inf"), uniform=0.0)


def test_weights_of_egos():
    table = hand_made([0.2, 0.6, 0.1, 0.0], [0.6, 0.1], egos=2)  # the second scenario has one ego
    drawn = np.arange(4) < 3
    by_step = sampling_weights(table, PLAIN, "step")
    np.testing.assert_allclose(by_step, np.outer([0.2, 0.6, 0.1, 0.0], drawn) / 0.3)
    by_scenario = sampling_weights(table, PLAIN, "scenario")
    np.testing.assert_allclose(by_scenario, np.outer([0.6, 0.6, 0.1, 0.0], drawn) / (1.3 / 3))
    draws = draw_statistics(by_scenario, table.drawable, 2)
    assert draws.effective_scenarios == pytest.approx((1.2 + 0.1) ** 2 / (1.2**2 + 0.1**2) / 2)
    usable = np.zeros((4, 4), bool)
    usable[1, 1] = usable[2, 2] = True
    weights = sampling_weights(table, PLAIN, "step", usable)
    assert weights[1, 1] == pytest.approx(0.6 / 0.35) and weights[2, 2] == pytest.approx(0.1 / 0.35)
    assert weights.sum() == pytest.approx(2.0)
    with pytest.raises(UsageError, match=r"scores of 2 egos per scenario, .* train with --egos moving"):
        sampling_weights(table, PLAIN, "step", usable[:2])


def test_scores_of_recorded_egos_weigh_all_egos():
    """A step is drawable if any ego can use it."""
    usable = np.zeros((4, 4), bool)
    usable[0, 0] = usable[1, 1] = usable[2, 1] = True
    weights = sampling_weights(hand_made([0.3, 0.1], [0.3, 0.1]), PLAIN, "step", usable)
    expected = np.array([[0.3, 0.3, 0.0, 0.0], [0.0, 0.1, 0.0, 0.0]]) / (0.7 / 3)
    np.testing.assert_allclose(weights, expected)


def test_permuted_scores_of_egos():
    """Scenarios are permuted as a whole."""
    rng = np.random.default_rng(0)
    steps = rng.random((60, 31))
    ids = tuple(map(str, range(20)))
    table = ScoreTable(
        "made", {}, "hash", ids, np.ones(steps.shape, bool), steps, steps.max(axis=1)[::3], {}, 3
    )
    control, drawn = permute_scores(table, 1), table.drawable
    own, other = (np.sort(each.steps[drawn].reshape(20, -1)) for each in (table, control))
    matches = (own[:, None] == other[None]).all(axis=2)
    assert (
        (matches.sum(axis=0) == 1).all() and (matches.sum(axis=1) == 1).all() and not matches.diagonal().all()
    )
    np.testing.assert_array_equal(control.scenarios, table.scenarios[matches.argmax(axis=0)])


def test_commands_score_all_egos(worlds, tmp_path, capsys):
    call = ["curate", "kinematic", "--data", str(worlds[0].path)]
    every, again = (str(tmp_path / name) for name in ("every.npz", "again.npz"))
    assert main([*call, "--out", every, "--egos", "moving"]) == 0
    assert "3 scenarios (9 egos in all), kinematic" in capsys.readouterr().out
    assert main([*call, "--out", again, "--again", every, "--weights", "urgency", "1"]) == 0
    table = read_scores(tmp_path / "again.npz", worlds[0])
    assert table.egos == EGOS
    np.testing.assert_array_equal(table.steps, np.where(table.valid, table.components["urgency"], 0.0))
    assert main([*call, "--out", again, "--again", every, "--egos", "moving", "--overwrite"]) == 2
    assert "leave out --egos" in capsys.readouterr().err
    control = ["curate", "random_matched", "--data", str(worlds[0].path), "--like", every, "--out"]
    assert main([*control, str(tmp_path / "control.npz")]) == 0
    assert read_scores(tmp_path / "control.npz", worlds[0]).egos == EGOS
