"""The list of all episodes: its data, and sorting and filtering in a browser."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from browser import acted, browse, needs_browser
from drivax.report.episodes import FAILURES, outcome, rank_scenarios, sort_worst_first
from drivax.report.pages.report import write_report
from drivax.report.runs import read_runs
from drivax.scenario.store import ScenarioSet, ScenarioWriter

from .conftest import SMALL, make_scenario, write_evaluation


def listed(html):
    return json.loads(re.search(r'<script type="application/json" id="list">(.*?)</script>', html)[1])


@pytest.fixture
def page(runs, tmp_path):
    return write_report(runs, tmp_path / "report.html", episodes=8)


def test_list_holds_every_episode_of_every_run(page, runs):
    data = listed(page.read_text())
    assert [run["name"] for run in data["runs"]] == ["expert", "constant", "policy"]
    names = [metric["name"] for metric in data["metrics"]]
    for folder, run in zip(runs, data["runs"], strict=False):
        with (folder / "episodes.csv").open() as file:
            rows = {row["scenario_id"]: row for row in csv.DictReader(file)}
        assert sorted(data["scenarios"][place] for place in run["scenario"]) == sorted(rows)
        for place, scenario in enumerate(run["scenario"]):
            row = rows[data["scenarios"][scenario]]
            for name, column in zip(names, run["values"], strict=True):
                assert column[place] == (
                    None if row[name] == "" else pytest.approx(float(row[name]), rel=1e-3)
                )
    bad = {metric["name"]: metric["bad"] for metric in data["metrics"]}
    assert (
        bad["collision"] == 1
        and bad["success"] == 0
        and bad["progress_ratio"] is bad["collision_type"] is None
    )
    (difficulty,) = data["tags"]
    words = [difficulty["words"][word] for (word,) in difficulty["of"]]
    assert words == ["hard" if int(name[-2:]) % 2 else "easy" for name in data["scenarios"]]
    assert sorted(data["played"].values()) == list(range(8))


def test_episodes_are_ranked_by_failure_score_and_other_planners(runs):
    policy = read_runs(runs)[0][-1]
    order = [FAILURES.index(next(f for f in FAILURES if f[0] == words)) if words != "success" else 99
             for words in (outcome(policy, row) for row in sort_worst_first(policy))]  # fmt: skip
    assert order == sorted(order) and order[-1] == 99 and order[0] < 99
    ids = [policy.keys["scenario_id"][row] for row in sort_worst_first(policy)]
    assert ids[:4] == ["hand-01", "hand-05", "hand-03", "hand-04"]
    assert ids[4:] == ["hand-06", "hand-07", "hand-02", "hand-00"], "the worst score first among the rest"
    # Of two equally bad ones that comes first which another planner drove well.
    evaluations = read_runs(runs)[0]
    evaluations[1].metrics["collision"][1] = 1
    evaluations[1].metrics["offroad"][5] = 0
    assert [choice.scenario_id for choice in rank_scenarios(evaluations)][:2] == ["hand-05", "hand-01"]


def test_page_without_rollouts_says_so(runs, tmp_path):
    text = write_report(runs, tmp_path / "report.html", episodes=0).read_text()
    assert (
        "This page has no rollouts and no tags" in text
        and listed(text)["tags"] == []
        and 'id="plots"' not in text
    )


ACT = """
  const $ = (selector) => document.querySelector(selector), form = $("#filters").elements;
  const ids = () => [...document.querySelectorAll("#rows tr")].map(
    (row) => row.querySelector("th").firstChild.textContent.replace("▶ ", "").slice(-2));
  const set = (name, word) => {
    const menu = form[name];
    menu.value = menu.options ? [...menu.options].find((one) => one.textContent.startsWith(word)).value : word;
    menu.dispatchEvent(new Event("input", { bubbles: true }));
    menu.dispatchEvent(new Event("change", { bubbles: true }));
  };
  const out = { first: ids() };
  set("failed", "collision"); out.collided = ids();
  form.all.click();
  set("metric", "progress"); set("sign", "≤"); set("bound", "0.7"); out.slow = ids();
  form.all.click();
  const hard = [...$("#tags").querySelectorAll("select")][0];
  hard.value = "1"; hard.dispatchEvent(new Event("input", { bubbles: true })); out.hard = ids();
  form.all.click();
  const button = [...document.querySelectorAll("#heads button")].find((one) => one.textContent.startsWith("progress"));
  button.click(); out.sorted = ids();
  const cell = [...document.querySelectorAll("td[data-link]")].find((node) => {
    const behind = JSON.parse(node.dataset.link);
    return behind.run === "constant" && behind.metric === "offroad" && !behind.tags;
  });
  cell.querySelector("button").click();
  out.behind = ids(); out.said = $("#count").textContent; out.playing = $("[data-control=title]").textContent;
  const kind = [...document.querySelectorAll("td[data-link]")].find(
    (node) => JSON.parse(node.dataset.link).kind === 5 && JSON.parse(node.dataset.link).run === "policy");
  kind.querySelector("button").click(); out.vulnerable = ids();
  $("#rows button").click(); out.played = $("[data-control=title]").textContent;
  document.title = JSON.stringify(out);
"""


@needs_browser
def test_list_sorts_filters_and_opens_episodes(page, tmp_path):
    dom = browse(acted(page, ACT), tmp_path, "--dump-dom", "--window-size=1280,1000")
    assert "data-error" not in re.search(r"<html[^>]*>", dom)[0]
    found = json.loads(re.search(r"<title>(.*?)</title>", dom)[1])
    assert found["first"] == ["01", "05", "03", "04", "06", "07", "02", "00"]
    assert found["collided"] == ["01", "05"]
    assert sorted(found["slow"]) == ["06", "07"], "the policy's progress is 1 - 0.05 times the number"
    assert sorted(found["hard"]) == ["01", "03", "05", "07"]
    assert found["sorted"] == ["07", "06", "05", "04", "03", "02", "01", "00"]
    assert (
        sorted(found["behind"]) == ["01", "03", "05", "07"] and found["said"] == "4 of 8 episodes of constant"
    )
    assert found["playing"].startswith(f"hand-{found['behind'][0]}"), "the first of them is opened at once"
    assert found["vulnerable"] == ["05"] and found["played"].startswith("hand-05")


@pytest.fixture
def half_tagged(tmp_path):
    """A page with one rollout; the scenarios 6 and 7 have no difficulty."""
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        for number in range(8):
            scenario = make_scenario(number)
            writer.add(scenario if number < 6 else replace(scenario, tags={"dataset": "hand"}))
    stored = ScenarioSet.open(tmp_path / "set")
    planners = ("expert", "policy")
    runs = [write_evaluation(tmp_path / name, name, stored, tmp_path / "set") for name in planners]
    return write_report(runs, tmp_path / "report.html", episodes=1)


BEHIND = """
  const text = (selector) => document.querySelector(selector).textContent;
  const told = (test) => {
    const cells = [...document.querySelectorAll("td[data-link]")];
    cells.find((cell) => test(JSON.parse(cell.dataset.link), cell)).querySelector("button").click();
    const ids = [...document.querySelectorAll("#rows th")].map((head) => head.firstChild.textContent.slice(-2));
    return [ids, text("#count"), text("[data-control=title]")];
  };
  const against = (cell) => cell.closest("table").className === "differences";
  document.title = JSON.stringify({
    difference: told((behind, cell) => against(cell) && behind.metric === "collision"),
    unknown: told((behind) => behind.run === "policy" && behind.tags?.difficulty === "unknown"
      && behind.metric === "success"),
  });
"""


@needs_browser
def test_cells_without_playable_episodes_say_so(half_tagged, tmp_path):
    dom = browse(acted(half_tagged, BEHIND), tmp_path, "--dump-dom", "--window-size=1280,1000")
    assert "data-error" not in re.search(r"<html[^>]*>", dom)[0]
    found = json.loads(re.search(r"<title>(.*?)</title>", dom)[1])
    ids, said, playing = found["difference"]
    assert ids == ["01", "05"] and said == "2 of 8 episodes of policy" and playing.startswith("hand-01")
    ids, said, _ = found["unknown"]
    assert ids == ["06"], "of the two without a tag one failed"
    assert said.startswith("1 of 8 episodes of policy. None of these plays in this page: --episodes N")


def thousandfold(folder):
    """Repeat the eight episodes of a run under names that the page ranks after the first eight."""

    def rename(text, copy):
        return text.replace("hand-", f"later-{copy}-") if copy else text

    header, *rows = (folder / "episodes.csv").read_text().splitlines()
    copies = [rename(row, copy) for copy in range(125) for row in rows]
    (folder / "episodes.csv").write_text("\n".join([header, *copies]) + "\n")
    with np.load(folder / "trajectories.npz") as archive:
        ids = [rename(str(name), copy) for copy in range(125) for name in archive["scenario_id"].astype(str)]
        arrays = {name: np.concatenate([archive[name]] * 125) for name in archive.files}
    np.savez(folder / "trajectories.npz", **(arrays | {"scenario_id": np.array(ids)}))


@pytest.mark.slow
@needs_browser
def test_thousand_episodes_open_in_two_seconds(runs, tmp_path):
    """Measure wall-clock time from the start of loading to the final layout."""
    for folder in runs[:3]:
        thousandfold(folder)
    html = write_report(runs, tmp_path / "report.html", episodes=1)
    assert len(listed(html.read_text())["runs"][2]["scenario"]) == 1000
    act = "<script>document.body.offsetHeight; document.title = String(performance.now())</script></body>"
    html.write_text(html.read_text().replace("</body>", act))
    times = []
    for _ in range(3):
        dom = browse(html, tmp_path, "--dump-dom", "--window-size=1280,1000", budget_ms=0)
        assert "1000 of 1000 episodes of policy" in dom
        times.append(float(re.search(r"<title>([\d.]+)</title>", dom)[1]) / 1000)
    assert 0 < min(times) < 2, times


@needs_browser
def test_plots_follow_the_player(page, tmp_path):
    act = """
      const scrub = document.querySelector("[data-control=scrub]");
      scrub.value = 60; scrub.dispatchEvent(new Event("input"));
      const plots = [...document.querySelectorAll("#plots figure")];
      document.title = JSON.stringify({
        words: plots.map((plot) => plot.querySelector("figcaption").firstChild.textContent),
        lines: plots.map((plot) => plot.querySelectorAll("path").length),
        speed: plots[0].querySelector("small:last-child").textContent,
        shown: document.querySelector("figure.pane:last-child .speed").textContent,
        at: plots[0].querySelector(".now").getAttribute("x1") });"""
    dom = browse(acted(page, act), tmp_path, "--dump-dom", "--window-size=390,900")
    found = json.loads(re.search(r"<title>(.*?)</title>", dom)[1])
    assert len(found["words"]) == 8 and found["words"][0] == "speed [m/s]" and found["lines"] == [3] * 8
    assert float(found["speed"].split()[-1]) == pytest.approx(float(found["shown"].split()[0]), abs=0.051)
    np.testing.assert_allclose(float(found["at"]), 44 + 60 / 90 * (380 - 44 - 8), atol=0.1)
