"""The viewer: its data, its errors, and its behaviour in a browser."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from browser import acted, browse, needs_browser
from drivax.cli import main
from drivax.curation.scores import Combination, ScoreTable, write_scores
from drivax.errors import UsageError
from drivax.report.pages.viewer import findings, select_rows, write_player
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Capacity
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from scenes import RED, car, straight_road

CLEAN = {"log_collides": False, "log_offroad_fraction": 0.0, "first_offroad_step": None, "log_runs_red": None}
FOUL = CLEAN | {
    "log_collides": True, "first_collision_step": 40, "log_offroad_fraction": 0.25, "first_offroad_step": 30,
    "log_runs_red": True,
}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "roads"
    made = (
        ("calm", [car(speed=8.0)], None, CLEAN, {"family": "plain"}),
        ("bad", [car(speed=12.0), car(x=40.0)], RED, FOUL, {"family": "</script><b>x"}),
        ("new", [car(speed=5.0)], None, {}, {"family": "plain", "event": "lead_brakes"}),
    )
    with ScenarioWriter(path, Capacity()) as writer:
        for name, cars, light, audit, tags in made:
            recording = replace(straight_road(cars, light=light), scenario_id=name)
            scenario = assemble(recording)
            writer.add(replace(scenario, audit=audit, tags=tags, overflow={"parked": 3} if audit else {}))
    return ScenarioSet.open(path)


@pytest.fixture
def page(data, tmp_path):
    return write_player(list(data), tmp_path / "page.html", title="roads & more")


def test_page_holds_the_logs(page, data):
    text = page.read_text()
    stored = [json.loads(one) for one in re.findall(r'class="episode">(.*?)</script>', text)]
    assert [one["id"] for one in stored] == ["calm", "bad", "new"] == [one["title"] for one in stored]
    for one, scenario in zip(stored, data, strict=True):
        (drive,) = one["rollouts"]
        pose = np.frombuffer(base64.b64decode(drive["pose"]), "<i2").reshape(-1, 3)
        xy = pose[:, :2] * one["unit"] + np.array(one["centre"])
        np.testing.assert_allclose(xy, scenario.agent_xy[:, 0], atol=0.02)
        speed = np.frombuffer(base64.b64decode(drive["speed"]), "<i2") / 100
        np.testing.assert_allclose(speed, np.linalg.norm(scenario.agent_velocity[:, 0], axis=-1), atol=0.01)
    assert [one["rollouts"][0]["events"] for one in stored] == [{}, {"collision": 40, "offroad": 30}, {}]
    assert [one["rollouts"][0]["outcome"] for one in stored] == ["", "collides, runs red, off-road", ""]


def test_details_list_tags_flags_audit_and_overflow(page):
    text = page.read_text()
    assert "<h1>roads &amp; more</h1>" in text
    assert "<b>3</b> recorded scenarios; the audit finds violations in 1 of 2." in text
    calm, bad, new = re.findall(r"<div hidden>(.*?)</div>", text, re.S)
    assert "<dt>log runs red</dt><dd>undefined</dd>" in calm
    assert "<dt>first offroad step</dt><dd>none</dd>" in calm
    assert "<dt>log collides</dt><dd>yes</dd>" in bad
    assert "<dt>log offroad fraction</dt><dd>0.25</dd>" in bad and "<dt>parked</dt><dd>3</dd>" in bad
    assert "not audited" in new and "<p>nothing</p>" in new and "<dd>lead_brakes</dd>" in new
    assert all("lane graph, speed limits" in one for one in (calm, bad, new))
    assert "<b>x" not in text, "names from the data are text, not markup"
    assert not re.search(r"(?:src|href)=|@import|url\(", text), "nothing is loaded from elsewhere"


def test_findings_are_words(data):
    assert [findings(scenario) for scenario in data] == ["", "collides, runs red, off-road", ""]


def test_select_by_id_and_limit(data):
    assert select_rows(data) == [0, 1, 2] and select_rows(data, limit=2) == [0, 1]
    assert select_rows(data, ids=("new", "calm"), order=[1, 0, 2]) == [2, 0]
    assert select_rows(data, limit=2, order=[1, 2, 0]) == [1, 2]
    with pytest.raises(UsageError) as error:
        select_rows(data, ids=("clam",))
    assert str(error.value) == f"{data.path}: record clam: is not in the set; did you mean 'calm'?"
    with pytest.raises(UsageError, match="use 1 or more"):
        select_rows(data, limit=0)


def test_existing_page_and_empty_selection_are_refused(page, data, tmp_path):
    before = page.read_bytes()
    with pytest.raises(UsageError, match="output file already exists; choose another or pass --overwrite"):
        write_player(list(data)[:1], page)
    with pytest.raises(UsageError, match="name a file to write"):
        write_player(list(data), tmp_path, overwrite=True)
    with pytest.raises(UsageError, match="no scenarios to show"):
        write_player([], tmp_path / "none.html")
    assert page.read_bytes() == before
    write_player(list(data)[:1], page, overwrite=True)
    assert page.read_text().count('class="episode"') == 1
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_view_command_plays_the_selected_scenarios(data, tmp_path, capsys):
    assert main(["view", str(data.path), "--limit", "2"]) == 0
    page = data.path.with_name("roads.html")
    assert "roads.html (2 of 3 scenarios, 0." in capsys.readouterr().out
    assert "<h1>roads</h1>" in page.read_text()
    assert main(["view", str(data.path)]) == 2
    assert main(["view", str(data.path), "--overwrite", "--ids", "new", "bad"]) == 0
    assert re.findall(r'"title":"(\w+)"', page.read_text()) == ["new", "bad"]
    assert main(["view", str(tmp_path)]) == 1


def test_critical_scenarios_come_first_with_their_components(data, tmp_path, capsys):
    valid = np.array([scenario.agent_valid[:, 0] for scenario in data])
    urgency = np.zeros(valid.shape)
    urgency[:, 20:30] = np.array([[0.2], [0.9], [0.5]])
    blank = ScoreTable(
        "kinematic",
        {},
        data.hash,
        ("calm", "bad", "new"),
        valid,
        urgency,
        urgency[:, 0],
        {"urgency": urgency},
    )
    write_scores(blank.recombine(Combination({"urgency": 1.0})), tmp_path / "scores.npz")
    out = tmp_path / "critical.html"
    arguments = ["view", str(data.path), "--scores", str(tmp_path / "scores.npz"), "--out", str(out)]
    assert main([*arguments, "--limit", "2"]) == 0
    text = out.read_text()
    assert re.findall(r"score (\S+), rank (\d) of 3 by kinematic", text) == [("0.900", "1"), ("0.500", "2")]
    assert text.count("criticality over time</figcaption>") == 2 and '"id":"calm"' not in text
    capsys.readouterr()
    assert main(["view", str(data.path), "--scores", str(tmp_path / "none.npz"), "--out", str(out)]) == 1
    assert "score table not found" in capsys.readouterr().err


def test_scores_are_those_of_the_scenario_if_data_sets_share_an_id(tmp_path):
    with ScenarioWriter(tmp_path / "set", Capacity()) as writer:
        for name, speed in (("first", 4.0), ("second", 9.0)):
            recording = replace(straight_road([car(speed=speed)]), scenario_id="same", dataset=name)
            writer.add(assemble(recording))
    both = ScenarioSet.open(tmp_path / "set")
    valid = np.array([scenario.agent_valid[:, 0] for scenario in both])
    urgency = np.where(valid, [[0.2], [0.9]], 0.0)
    table = ScoreTable(
        "kinematic", {}, both.hash, ("same", "same"), valid, urgency, urgency[:, 0], {"urgency": urgency}
    )
    write_scores(table.recombine(Combination({"urgency": 1.0})), tmp_path / "scores.npz")
    out = tmp_path / "both.html"
    assert main(["view", str(both.path), "--scores", str(tmp_path / "scores.npz"), "--out", str(out)]) == 0
    text = out.read_text()
    assert re.findall(r"score (\S+), rank (\d) of 2", text) == [("0.900", "1"), ("0.200", "2")]
    speeds = [
        json.loads(one)["rollouts"][0]["speed"] for one in re.findall(r'class="episode">(.*?)</script>', text)
    ]
    assert [np.frombuffer(base64.b64decode(speed), "<i2")[10] for speed in speeds] == [900, 400]


def test_each_scenario_has_its_details(data, tmp_path):
    with pytest.raises(ValueError, match="shorter"):
        write_player(list(data), tmp_path / "page.html", details=["only one"])


@needs_browser
def test_page_works_in_a_browser(page, tmp_path):
    """Open the second scenario, then the next by key, then filter for the first."""
    act = """
      const opened = document.querySelector("[data-control=title]").textContent;
      document.body.dispatchEvent(new KeyboardEvent("keydown", {key: "n", bubbles: true}));
      const filter = document.getElementById("filter");
      filter.value = "PLAIN calm"; filter.dispatchEvent(new Event("input"));
      setTimeout(() => {
        const seen = [...document.querySelectorAll("[data-episode]")].map((button) => !button.hidden);
        const facts = [...document.getElementById("details").children].map((fact) => !fact.hidden);
        const speed = document.querySelector(".speed").textContent;
        const title = document.querySelector("[data-control=title]").textContent;
        document.title = JSON.stringify({ opened, title, seen, facts, speed, at: location.hash });
      }, 100);"""
    dom = browse(acted(page, act), tmp_path, "--dump-dom", "--window-size=1300,900", fragment="#2")
    assert "data-error" not in re.search(r"<html[^>]*>", dom)[0]
    assert json.loads(re.search(r"<title>(.*?)</title>", dom)[1]) == {
        "opened": "bad",
        "title": "new",
        "seen": [True, False, False],
        "facts": [False, False, True],
        "speed": "5.0 m/s",
        "at": "#3",
    }
