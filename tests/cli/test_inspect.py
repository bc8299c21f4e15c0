"""``drivax inspect``: one set in full, several side by side, filters, JSON and the page with histograms."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from drivax.cli import main
from drivax.report.inspection import Inspection, finding_text
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES
from drivax.scenario.store import ScenarioWriter
from scenes import car, straight_road

COLUMNS = 100


def write(path, places, clean):
    """A set of one scenario per place: k others, ego drives 8 k metres, the audit as given."""
    with ScenarioWriter(path, CAPACITIES["default"]) as writer:
        for k, (place, good) in enumerate(zip(places, clean, strict=True)):
            cars = [car(0, 0, 0, k), *(car(10 + 10 * i, 3.7, 0, 0) for i in range(k))]
            tags = {} if place is None else {"place": place}
            recording = replace(straight_road(cars), scenario_id=f"s{k}", segment=f"rec{k // 2}", tags=tags)
            audit = {
                "log_collides": not good,
                "distance_m": 8.0 * k,
                "first_offroad_step": None,
                "clean": good,
            }
            scenario = replace(assemble(recording), audit=audit)
            writer.add(replace(scenario, tags={**scenario.tags, "fleet": "a" if k else "b"}))
    return path


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inspect")
    one = write(folder / "one", ["boston", "boston", "pittsburgh", None], [True, True, True, False])
    two = write(folder / "two", ["singapore", "singapore"], [True, True])
    return one, two


@pytest.fixture
def inspect(capsys):
    def call(*words, status=0):
        assert main(["inspect", *map(str, words)]) == status
        captured = capsys.readouterr()
        return captured.err if status else captured.out

    return call


def cells(text, name):
    """The rest of the line that begins with ``name``, its runs of spaces joined."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"{name} ")]
    return " ".join(line.removeprefix(name).split())


def test_one_set_in_full(sets, inspect):
    out = inspect(sets[0])
    assert max(map(len, out.splitlines())) <= COLUMNS
    assert cells(out, "scenarios") == "4 (recorded segments: 2, shards: 1)"
    assert cells(out, "place") == "boston (2 of 4), pittsburgh (1 of 4)"
    assert cells(out, "duration") == "0.60 min at 10 Hz"  # 4 times 9.0 s
    assert cells(out, "integrity") == "all checksums match"
    assert cells(out, "log_collides") == "1 of 4 (25 %) 4"
    assert cells(out, "distance_m") == "mean 12, median 12, max 24 4"
    assert "first_offroad_step" not in out
    assert cells(out, "s3").split()[:3] == ["91", "4", "4"]


def test_skipped_and_filtered_records_are_reported(tmp_path, inspect):
    rows = [{"file": "a.tfrecord", "record": None, "problem": "is cut off"}]
    rows += [{"file": "b.tfrecord", "record": k, "problem": "the ego jumps"} for k in range(4)]
    source = {"skipped": 5, "skipped_records": rows, "filtered": 2, "filters": ["agents>1", "place=x"]}
    with ScenarioWriter(tmp_path / "set", CAPACITIES["default"], source) as writer:
        writer.add(assemble(straight_road([car(0, 0, 0, 8)])))
    out = inspect(tmp_path / "set")
    assert cells(out, "skipped") == "5 records that could not be converted"
    assert "a.tfrecord: is cut off" in out and "b.tfrecord: record 1: the ego jumps" in out
    assert "record 2" not in out and "2 more in manifest.json" in out
    assert cells(out, "filtered") == "2 scenarios left out by agents>1 and place=x"
    assert cells(inspect(tmp_path / "set", tmp_path / "set"), "skipped") == "5 5"


def test_distances_are_not_summed():
    assert finding_text([1.0, 2.0, 6.0]) == "mean 3, median 2, max 6"
    assert finding_text([True, False, True, True]) == "3 of 4 (75 %)"
    assert (
        finding_text(["measured", "measured", "differentiated"])
        == "differentiated (1 of 3), measured (2 of 3)"
    )


def test_multiple_sets_are_compared_in_columns(sets, inspect):
    out = inspect(*sets)
    assert max(map(len, out.splitlines())) <= COLUMNS
    assert out.split()[:2] == ["one", "two"]
    assert cells(out, "scenarios") == "4 2"
    assert cells(out, "recordings") == "2 1"
    assert cells(out, "places") == "boston, pittsburgh singapore"
    assert cells(out, "rate") == "10 Hz 10 Hz"
    assert cells(out, "duration") == "0.60 min 0.30 min"
    assert cells(out, "agents now") == "2.50 1.50"
    assert cells(out, "lanes") == "3 3"
    assert cells(out, "ego drives, m") == "12 4"
    assert cells(out, "log_collides") == "25 % 0 %"
    assert cells(out, "fleet a") == "75 % 50 %"


def test_tables_of_many_sets_fit_the_terminal(sets, inspect):
    out = inspect(*sets, *sets, *sets)
    assert max(map(len, out.splitlines())) <= COLUMNS
    assert len([line for line in out.splitlines() if line.startswith("scenarios ")]) == 2


def test_filters_select_the_scenarios_that_are_summarised(sets, inspect):
    out = inspect(sets[0], "--filter", "place=boston|pittsburgh", "--filter", "audit.distance_m>0")
    assert cells(out, "scenarios") == "2 of 4 (recorded segments: 2, shards: 1)"
    assert "1 lack the value of 'place=boston|pittsburgh'" in out
    assert cells(out, "distance_m") == "mean 12, median 12, max 16 2"
    chosen = json.loads(inspect(sets[0], "--json", "--filter", "agents>=3"))
    assert [row["scenario_id"] for row in chosen["scenarios"]] == ["s2", "s3"]
    line = inspect(sets[0], "--filter", "place=singapore", status=1)
    assert len(line.splitlines()) == 1 and "none of 4 scenarios has place=singapore (1 lack" in line
    line = inspect(sets[0], "--filter", "plce=singapore", status=2)
    assert len(line.splitlines()) == 1 and "did you mean 'place'?" in line


def test_json_of_one_set_and_of_several(sets, inspect):
    one = json.loads(inspect(sets[0], "--json"))
    both = json.loads(inspect(*sets, "--json"))
    assert list(one) == ["scenarios"] and len(one["scenarios"]) == 4
    assert [row["set"] for row in both] == [str(path) for path in sets]
    assert both[0]["scenarios"] == one["scenarios"] and len(both[1]["scenarios"]) == 2


def test_html_page_is_replaced_only_with_overwrite(sets, inspect, tmp_path):
    page = tmp_path / "page.html"
    assert inspect(*sets, "--html", page).split() == [str(page)]
    text = page.read_text()
    assert "<svg" in text and "boston" in text and "speed of ego" in text
    again = inspect(*sets, "--html", page, status=2)
    assert "--overwrite" in again and len(again.splitlines()) == 1
    inspect(*sets, "--html", page, "--overwrite")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


@pytest.mark.slow
def test_observation_statistics_are_printed_and_drawn(sets, inspect, tmp_path):
    """Described as a table and as JSON, and drawn; the task is that of a training configuration."""
    observation = "{agents: 2, steps: 2, road: 20, lights: 1, route: 2}"
    task = f"task: {{actions: published, observation: {observation}}}\n"
    (tmp_path / "lean.yaml").write_text(task)
    words = (sets[0], "--observations", "--task", tmp_path / "lean.yaml", "--planner", "constant_velocity")
    out = inspect(*words, "--draw", tmp_path / "seen.png")
    assert max(map(len, out.splitlines())) <= COLUMNS
    assert out.startswith(
        "32 states of 4 episodes of constant_velocity, 0 with a collision; every number is f"
    )
    assert "\nagents" in out and "\n  velocity ahead " in out
    assert (tmp_path / "seen.png").read_bytes().startswith(b"\x89PNG")
    again = inspect(*words, "--draw", tmp_path / "seen.png", status=2)
    assert "--overwrite" in again and len(again.splitlines()) == 1
    found = json.loads(inspect(*words, "--json"))
    assert (found["states"], found["episodes"], found["planner"]) == (32, 4, "constant_velocity")
    assert {row["group"] for row in found["features"]} == {
        "ego",
        "ego_static",
        "agents",
        "road",
        "lights",
        "route",
    }
    assert all(row["broken"] == 0 and row["importance"] is None for row in found["features"])
    (length,) = [row for row in found["features"] if (row["group"], row["name"]) == ("agents", "length")]
    # 0, 1, 2 and 3 others, of which two are seen, at both steps of eight looks; all are as long.
    assert length["count"] == (0 + 1 + 2 + 2) * 2 * 8 and length["mean"] == pytest.approx(4.8 / 5)


@pytest.mark.slow
def test_importance_of_features_to_a_trained_policy(sets, inspect):
    """The policy of the zoo brings its own task; permuting what it sees changes what it does."""
    found = json.loads(inspect(sets[0], "--observations", "--planner", "zoo:aggressive", "--json"))
    assert found["permuted"] == found["states"] == 32 and found["planner"] == "aggressive"
    known = {
        (row["group"], row["name"]): row["importance"]
        for row in found["features"]
        if row["importance"] is not None
    }
    assert {group for group, _ in known} >= {"ego", "agents", "road"} and "route" not in dict(known)
    assert all(np.isfinite(value) and 0.0 <= value < 10.0 for value in known.values())
    assert known["ego", "velocity ahead"] > 0.0 and found["groups"]["road"] > 0.0


@pytest.mark.parametrize(
    ("words", "said", "status"),
    [
        ([], "no scenario set", 2),
        (["ONE", "--draw", "x.png"], "--draw needs --observations", 2),
        (["ONE", "--traffic", "idm"], "--traffic needs --observations", 2),
        (["ONE", "--trust-code", "own"], "--trust-code needs --observations", 2),
        (["ONE", "ONE", "--observations"], "one set", 2),
        (["ONE", "--observations", "--planner", "nobody"], "unknown planner 'nobody'", 2),
        (["ONE", "--json", "--html", "x.html"], "mutually exclusive", 2),
        (["gone"], "gone", 1),
    ],
)
def test_wrong_calls_get_one_line(words, said, status, sets, inspect):
    line = inspect(*(sets[0] if word == "ONE" else word for word in words), status=status)
    assert said in line and len(line.splitlines()) == 1


def test_picture_is_no_folder(sets, inspect, tmp_path):
    line = inspect(sets[0], "--observations", "--draw", tmp_path, "--overwrite", status=2)
    assert "output is a folder; name a file to write" in line


def test_samples_are_evenly_spread(sets, monkeypatch):
    from drivax.report import inspection
    from drivax.scenario.select.selection import Selection

    one = Inspection.open(sets[0], Selection())
    assert [scenario.id for scenario in one.sample()] == ["s0", "s1", "s2", "s3"]
    monkeypatch.setattr(inspection, "SAMPLE", 2)
    assert [scenario.id for scenario in one.sample()] == ["s0", "s3"]
    speeds = inspection.read_speeds(one)
    assert speeds.scenarios == 2
    np.testing.assert_allclose(speeds.ego, [0.0] * 91 + [3.0] * 91, atol=1e-5)


@pytest.mark.slow
def test_the_picture_shows_the_current_step_of_a_short_log(tmp_path, inspect, monkeypatch):
    log = straight_road([car(speed=5.0)])
    short = assemble(replace(log, scenario_id="short"))
    record = short.record.copy()
    record["current_step"] = 7
    with ScenarioWriter(tmp_path / "set", CAPACITIES["default"]) as writer:
        writer.add(replace(short, record=record))
    drawn = []

    class Picture:
        def savefig(self, file, format):
            file.write(b"half")
            if drawn[1:]:
                raise OSError("interrupted")

    def draw(task, bank, title, step):
        drawn.append((title, step))
        return Picture()

    monkeypatch.setattr("drivax.report.pictures.observation.draw_log_observation", draw)
    words = (tmp_path / "set", "--observations", "--draw", tmp_path / "seen.png")
    inspect(*words)
    assert drawn == [("short, step 7", 7)] and (tmp_path / "seen.png").read_bytes() == b"half"
    (tmp_path / "seen.png").write_bytes(b"old")
    inspect(*words, "--overwrite", status=1)
    assert (tmp_path / "seen.png").read_bytes() == b"old"
    assert {path.name for path in tmp_path.iterdir()} == {"set", "seen.png"}
