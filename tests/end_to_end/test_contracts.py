"""The machine-readable contracts, through the command line, on the built-in world."""

import csv
import json

import jsonschema
import numpy as np
import pytest

from drivax.cli import main
from drivax.evaluation.episode_table import ADDED, KEYS
from drivax.metrics.catalogue import METRICS
from drivax.scenario.store import ScenarioSet
from drivax.studies import bench
from drivax.synthetic.generate import Generation, generate

NUMBER, WHOLE = {"type": "number"}, {"type": "integer", "minimum": 0}
MAYBE = {"type": ["number", "null"]}


def exactly(**properties):
    return {
        "type": "object", "properties": properties, "required": sorted(properties), "additionalProperties": False,
    }  # fmt: skip


SUMMARY = exactly(
    planner={"type": "string"},
    traffic={"enum": ["log", "idm"]},
    metrics={
        "type": "object",
        "additionalProperties": exactly(mean=MAYBE, low=MAYBE, high=MAYBE, n=WHOLE),
        "minProperties": 20,
    },
)
KINDS = ("lane", "road_line", "road_edge", "crosswalk", "speed_bump", "stop_sign", "driveway")
INSPECT = exactly(
    scenarios={
        "type": "array",
        "minItems": 1,
        "items": exactly(
            scenario_id={"type": "string"}, dataset={"type": "string"}, segment={"type": "string"}, steps=WHOLE,
            tracks=WHOLE, tracks_valid_now=WHOLE, map_features=exactly(**dict.fromkeys(KINDS, WHOLE)),
            map_points=WHOLE, lights=WHOLE, segments=WHOLE, overflow={"type": "object"},
            flags={"type": "array", "items": {"type": "string"}}, audit={"type": "object"}, lost={"type": "object"},
            origin={"type": "array", "items": NUMBER, "minItems": 3, "maxItems": 3},
        ),
    }
)  # fmt: skip
BENCH = {
    "type": "object",
    "required": [
        "environment_steps_per_second", "batch", "state_bytes", "compile_seconds", "brute_force_ratio", "by_part",
        "cost_by_part", "versions",
    ],
    "properties": {
        "environment_steps_per_second": NUMBER, "batch": WHOLE, "state_bytes": {"type": "integer", "maximum": 4096},
        "compile_seconds": NUMBER, "brute_force_ratio": NUMBER,
        "by_part": {"type": "object", "additionalProperties": NUMBER, "minProperties": 8},
        "cost_by_part": {
            "type": "object", "additionalProperties": exactly(operations=WHOLE, bytes=WHOLE), "minProperties": 8,
        },
        "versions": {"type": "object"},
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("contracts") / "set"
    generate(path, 6, 21, Generation(workers=0))
    return path


@pytest.fixture(scope="module")
def evaluation(data):
    """Five of the six scenarios are driven."""
    out = data.parent / "constant"
    call = ["evaluate", "--planner", "constant_velocity", "--data", str(data), "--out", str(out)]
    assert main([*call, "--limit", "5"]) == 0
    return out


def test_episodes_csv_has_the_declared_columns_and_values(evaluation, data):
    with (evaluation / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [*KEYS, *METRICS, *ADDED]
    assert len(ScenarioSet.open(data)) == 6 and len(rows) == 5
    assert [row["scenario_id"] for row in rows] == [one.id for one in ScenarioSet.open(data)][:5]
    assert {(row["planner"], row["traffic"], row["dataset"]) for row in rows} == {
        ("constant_velocity", "log", "drivax")
    }
    for row in rows:
        values = {name: float(row[name]) for name in METRICS if row[name] != ""}
        assert values["steps"] == 80.0
        assert values["accuracy"] == float(
            not (values["collision"] or values["offroad"] or values["red_light"])
        )
        assert all(
            0 <= values[name] <= 1 for name in ("vmax_score", "nuplan_score", "progress_ratio", "comfort")
        )
        # A full score and its partial one never stand side by side.
        assert (row["vmax_score"] == "") != (row["vmax_score_partial"] == "")


def test_summary_is_recomputable(evaluation):
    summary = json.loads((evaluation / "summary.json").read_text())
    jsonschema.validate(summary, SUMMARY)
    with (evaluation / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for name, value in summary["metrics"].items():
        cells = [float(row[name]) for row in rows if row[name] != ""]
        assert value["n"] == len(cells)
        if cells:
            assert value["mean"] == pytest.approx(np.mean(cells), rel=1e-4, abs=1e-5)
            assert value["low"] is None or value["low"] <= value["mean"] <= value["high"]
        else:
            assert value["mean"] is None


def test_trajectories_have_the_declared_shapes_and_types(evaluation):
    with np.load(evaluation / "trajectories.npz") as arrays:
        assert arrays["ego"].shape == (5, 81, 4) and arrays["ego"].dtype == np.float32
        assert (arrays["start"] == 10).all() and np.isfinite(arrays["ego"]).all()
        assert arrays["action"].shape == (5, 80, 2) and arrays["action"].dtype == np.float16
        assert not arrays["action"].any(), "a constant velocity asks for nothing"


def test_inspect_json_matches_its_schema(data, capsys):
    assert main(["inspect", str(data), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    jsonschema.validate(found, INSPECT)
    assert len(found["scenarios"]) == 6


#: A task and parts that compile three times as fast as what is timed by default.
LEAN = ["--task.metrics", "none", "--task.observation.road", "0", "--task.observation.steps", "1"]
QUICK = ("dynamics", "agents", "contacts", "ttc", "edges", "lanes", "route", "metrics")


@pytest.mark.slow
def test_bench_json_matches_its_schema(data, capsys, monkeypatch):
    parts = bench._parts
    monkeypatch.setattr(bench, "_parts", lambda of: {name: parts(of)[name] for name in QUICK})
    check_bench(data, capsys, LEAN)


@pytest.mark.slow
def test_bench_of_the_default_task_and_all_parts(data, capsys):
    check_bench(data, capsys, [])


def check_bench(data, capsys, task):
    assert main(["bench", "--data", str(data), "--batch", "4", "--repeats", "1", "--json", *task]) == 0
    jsonschema.validate(json.loads(capsys.readouterr().out), BENCH)


@pytest.mark.slow
def test_bench_by_metric_set(data, capsys, monkeypatch):
    monkeypatch.setattr(bench, "BATCHES", (2,))
    monkeypatch.setattr(bench, "LARGER_BATCHES", (4,))
    assert main(["bench", "--data", str(data), "--repeats", "1", "--metrics", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert list(dict.fromkeys(row["metrics"] for row in rows)) == ["none", "training", "full"]
    for name in ("none", "training", "full"):
        (best,) = [row for row in rows if row["metrics"] == name and row["best"]]
        sizes = {row["batch"]: row["steps_per_second"] for row in rows if row["metrics"] == name}
        # The larger size has a row where it is the best, and no row is faster than the best.
        assert set(sizes) == {2, best["batch"]} and max(sizes.values()) == best["steps_per_second"]
    assert all(row["steps_per_second"] > 0 for row in rows)
    assert next(row["relative"] for row in rows if (row["metrics"], row["batch"]) == ("full", 2)) == 1.0


@pytest.mark.slow
def test_subset_has_the_rows_of_the_full_set(evaluation, data, tmp_path, capsys):
    names = [one.id for one in ScenarioSet.open(data)]
    (tmp_path / "some.txt").write_text("\n".join(names[2:]))
    call = ["evaluate", "--planner", "constant_velocity", "--data", str(data), "--out", str(tmp_path / "run")]
    more = ["--scenarios", names[0], str(tmp_path / "some.txt"), "--filter", "agents>0", "--limit", "3"]
    assert main([*call, *more, "--batch", "2", "--metrics", "comfort", "min_ttc"]) == 0
    whole, part = (
        (folder / "episodes.csv").read_text().splitlines() for folder in (evaluation, tmp_path / "run")
    )
    assert part == [whole[row] for row in (0, 1, 3, 4)]
    out = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in out if line.startswith(("metric", "comfort", "min_ttc"))] == [
        "metric", "comfort", "min_ttc",
    ]  # fmt: skip
    config = (tmp_path / "run" / "config.yaml").read_text()
    assert "agents>0" in config and names[0] in config and not (tmp_path / "run" / "crashes.json").exists()


@pytest.mark.slow
def test_python_planner_that_raises_is_a_crash(data, tmp_path, capsys):
    """It raises where ego begins faster than 12 m/s."""
    speed = {one.id: float(np.hypot(*one.agent_velocity[10, 0])) for one in ScenarioSet.open(data)}
    fast = [name for name in speed if speed[name] > 12.0]
    assert 0 < len(fast) < len(speed)
    call = [
        "evaluate",
        "--planner",
        "own_drivers:no_haste",
        "--data",
        str(data),
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(call) == 0
    with (tmp_path / "run" / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["scenario_id"] for row in rows] == list(speed)
    assert [row["scenario_id"] for row in rows if row["crashed"] == "1"] == fast
    assert {(row["success"], row["collision"]) for row in rows if row["crashed"] == "1"} == {("0", "0")}
    crashes = json.loads((tmp_path / "run" / "crashes.json").read_text())
    assert [(crash["scenario_id"], crash["step"]) for crash in crashes] == [(name, 10) for name in fast]
    out = capsys.readouterr().out
    assert f"no_haste crashed in {len(fast)} of {len(speed)} episodes, which count as failed:" in out
    assert f"{fast[0]}, step 10: ValueError: too fast (own_drivers.py:" in out
    jsonschema.validate(json.loads((tmp_path / "run" / "summary.json").read_text()), SUMMARY)


def test_report_page_shows_the_planner(evaluation, data):
    out = data.parent / "report.html"
    assert main(["report", str(evaluation), "--out", str(out)]) == 0
    page = out.read_text()
    assert "constant_velocity" in page and "<script>" in page


@pytest.mark.parametrize(
    ("arguments", "words", "status"),
    [
        (["--planner", "idn", "--data", "SET", "--out", "NEW"], ["idn", "idm"], 2),
        (["--planner", "idm", "--data", "MISSING", "--out", "NEW"], ["MISSING"], 1),
        (["--planner", "idm", "--data", "SET", "--out", "OLD"], ["--overwrite"], 2),
        (["--planner", "idm", "--data", "SET", "--out", "NEW", "--start-step", "90"], ["90"], 2),
        (["--planner", "idm", "--data", "SET", "--out", "NEW", "--limit", "0"], ["--limit 0"], 2),
        (["--planner", "SET", "--data", "SET", "--out", "NEW"], ["not a run folder"], 1),
        (
            ["--planner", "idm", "--data", "SET", "--out", "NEW", "--filter", "type=juncton"],
            ["'junction'"],
            2,
        ),
        (
            ["--planner", "idm", "--data", "SET", "--out", "NEW", "--scenarios", "w1"],
            ["'w1'", "not in the set"],
            1,
        ),
        (["--planner", "own_drivers:plain", "--data", "SET", "--out", "NEW"], ["@drivax.python_planner"], 2),
        (["--planner", "idm", "--data", "SET", "--out", "NEW", "--metrics", "min_tcc"], ["'min_ttc'"], 2),
        (["--planner", "idm", "--data", "SET", "--out", "NEW", "--batch", "0"], ["batch of 0"], 2),
    ],
)
def test_wrong_calls_get_one_line(arguments, words, status, evaluation, data, capsys, tmp_path):
    places = {
        "SET": str(data),
        "NEW": str(tmp_path / "new"),
        "OLD": str(evaluation),
        "MISSING": str(tmp_path / "MISSING"),
    }
    assert main(["evaluate", *(str(places.get(word, word)) for word in arguments)]) == status
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("drivax: ")]
    assert len(lines) == 1 and all(word in lines[0] for word in words), captured.err
    assert not (tmp_path / "new").exists()
