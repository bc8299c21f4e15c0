from __future__ import annotations

import base64
import csv
import json
import math
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from browser import acted, browse, needs_browser
from drivax.cli import main
from drivax.errors import DataError, UsageError
from drivax.evaluation.result_tables import metric_label
from drivax.metrics.catalogue import METRICS
from drivax.report.pages.report import _provenance, write_report
from drivax.report.pictures.palette import LIGHT
from drivax.report.pictures.player_data import ABSENT
from drivax.report.runs import TrainingCurves, read_runs
from drivax.scenario.store import ScenarioWriter
from drivax.stats.intervals import wilson

from .conftest import SMALL, make_scenario, offset_path, redescribe

VOID = {"meta", "input", "br", "wbr", "link", "img"}


class Page(HTMLParser):
    """Collects tables, scripts and text, and checks that elements nest."""

    def __init__(self, html):
        super().__init__()
        self.open, self.tables, self.scripts, self.links, self.text = [], [], [], [], ""
        self.cell = None
        self.feed(html)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.links += [
            (tag, value) for name, value in attrs.items() if name in ("src", "href", "srcset", "action")
        ]
        if tag in VOID:
            return
        self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag == "script":
            self.scripts.append((attrs, ""))
        elif tag in ("small", "em") and "table" in self.open:
            self.tables[-1][-1][-1] += "|"

    def handle_endtag(self, tag):
        if "svg" in self.open or tag not in VOID:
            assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            attrs, text = self.scripts[-1]
            self.scripts[-1] = (attrs, text + data)
        elif "td" in self.open or "th" in self.open:
            self.tables[-1][-1][-1] += data
        else:
            self.text += data


@pytest.fixture
def page(runs, tmp_path):
    html = write_report(runs, tmp_path / "report.html").read_text(encoding="utf-8")
    return html, Page(html)


def test_page_is_self_contained(page):
    html, parsed = page
    assert not parsed.links and "url(" not in html and "@import" not in html
    assert not re.search(
        r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}/", re.sub(r'<script type="application/json".*', "", html)
    )
    assert "default-src 'none'" in html
    assert "fetch(" not in html and "XMLHttpRequest" not in html and "import(" not in html


def test_tables_equal_the_csv_files(page, runs):
    """Means, intervals and n of every rate, recomputed with nothing but the csv module and Wilson's formula."""
    _, parsed = page
    header, *rows = parsed.tables[0]
    labels = {metric_label(name).text: name for name in METRICS}
    columns = [labels[re.sub(r" [↑↓]$", "", cell.strip())] for cell in header[1:]]
    assert columns[0] == "success" and "red_light" in columns and len(rows) == 3
    for folder, row in zip(runs, rows, strict=False):
        with (folder / "episodes.csv").open() as file:
            episodes = list(csv.DictReader(file))
        assert row[0].startswith(folder.name)
        for name, cell in zip(columns, row[1:], strict=True):
            values = [float(e[name]) for e in episodes if e[name] != ""]
            mean, interval, n = cell.split("|")
            assert n == f"n {len(values)}"
            if metric_label(name).unit == "rate":
                assert mean == f"{100 * sum(values) / len(values):.1f} %"
                if sum(values) in (0, len(values)):  # nothing varies: clusters count once
                    clusters = len({e["segment"] for e in episodes if e[name] != ""})
                    found = wilson(clusters if sum(values) else 0, clusters)
                    assert interval == f"{100 * found.low:.1f}–{100 * found.high:.1f}"
            else:
                assert mean == f"{sum(values) / len(values):.3f}"


def test_undefined_metric_is_an_empty_cell_with_n_0(page):
    _, parsed = page
    header, *rows = parsed.tables[1]
    place = [re.sub(r" [↑↓]$", "", cell.strip()) for cell in header].index("minimum TTC [s]")
    assert all(row[place] == "–|n 0" for row in rows)


def test_differences_equal_the_csv_files(page, runs):
    _, parsed = page
    header, *rows = parsed.tables[2]
    assert header[1:] == ["expert", "constant"]
    table = {}
    for folder in runs[:3]:
        with (folder / "episodes.csv").open() as file:
            table[folder.name] = {e["scenario_id"]: e for e in csv.DictReader(file)}
    labels = {metric_label(name).text: name for name in METRICS}
    for row in rows:
        name = labels[re.sub(r" [↑↓]$", "", row[0].strip())]
        for other, cell in zip(("expert", "constant"), row[1:], strict=True):
            pairs = [
                float(mine[name]) - float(table[other][key][name])
                for key, mine in table["policy"].items()
                if mine[name] != "" and table[other][key][name] != ""
            ]
            mean = cell.split("|")[0].replace("−", "-").removesuffix(" points")
            scale = 100 if metric_label(name).unit == "rate" else 1
            assert math.isclose(
                float(mean), scale * sum(pairs) / len(pairs), abs_tol=0.051 if scale > 1 else 0.00051
            )
            assert cell.endswith(f"n {len(pairs)}")


def test_player_data_parse_and_cannot_end_their_element(page):
    html, parsed = page
    data = [json.loads(text) for attrs, text in parsed.scripts if attrs.get("type") == "application/json"]
    style, *episodes, listed = data
    assert {"signals", "strokes", "widths"} <= set(style) and len(listed["runs"]) == 3
    assert set(style["themes"]) == {"light", "dark"} and len(episodes) == 8
    assert [d["planner"] for d in episodes[0]["rollouts"]] == ["expert", "constant", "policy"]
    assert episodes[0]["title"].endswith(": collision") and episodes[0]["rollouts"][2]["events"] == {
        "collision": 40
    }
    assert "<b>not markup</b>" not in html and "&lt;b&gt;not markup" in html
    assert html.count("data-episode aria") == 8
    assert len(html.encode()) < 600_000


def test_steps_before_the_takeover_are_the_log(page, scenarios):
    """The stored path starts at the takeover; the page shows the log before."""
    _, parsed = page
    episode = next(json.loads(t) for a, t in parsed.scripts if a.get("class") == "episode")
    from .test_player_data import shorts

    assert episode["id"] == "hand-01"
    pose = shorts(episode["rollouts"][2]["pose"], 91, 3)[:, :2] * episode["unit"] + episode["centre"]
    np.testing.assert_allclose(pose[:10], scenarios[1].agent_xy[:10, 0], atol=episode["unit"])
    np.testing.assert_allclose(pose[10:], offset_path(scenarios[1], 3.0)[10:, :2], atol=episode["unit"])


def test_moved_set_is_an_error_unless_given(runs, tmp_path, hand_set):
    for folder in runs[:3]:
        about = json.loads((folder / "run.json").read_text())
        about["data"]["path"] = str(tmp_path / "gone")
        (folder / "run.json").write_text(json.dumps(about))
    with pytest.raises(DataError, match="--data SET") as caught:
        write_report(runs, tmp_path / "report.html")
    assert str(tmp_path / "gone") in str(caught.value) and not (tmp_path / "report.html").exists()
    assert write_report(runs, tmp_path / "report.html", data=hand_set).stat().st_size > 100_000
    assert write_report(runs, tmp_path / "tables.html", episodes=0).stat().st_size < 100_000


def test_other_set_is_refused(runs, tmp_path):
    with ScenarioWriter(tmp_path / "other", SMALL) as writer:
        writer.add(make_scenario(0))
    with pytest.raises(DataError, match="not the set that 'policy' was evaluated on"):
        write_report(runs, tmp_path / "report.html", data=tmp_path / "other")
    about = json.loads((runs[2] / "run.json").read_text())
    (runs[2] / "run.json").write_text(json.dumps(about | {"data": {"path": str(tmp_path / "other")}}))
    with pytest.raises(DataError, match=r"record hand-0[1-7]: is not in the scenario set"):
        write_report(runs, tmp_path / "report.html")
    (runs[2] / "run.json").write_text(json.dumps(about | {"data": {}}))
    with pytest.raises(DataError, match="no scenario set recorded"):
        write_report(runs, tmp_path / "report.html")


def test_failed_write_leaves_the_old_page(runs, tmp_path, monkeypatch):
    out = tmp_path / "out" / "report.html"
    write_report(runs, out)
    before = out.read_bytes()
    with pytest.raises(UsageError, match="--overwrite"):
        write_report(runs, out)
    with pytest.raises(UsageError, match="name a file to write"):
        write_report(runs, out.parent, overwrite=True)
    with pytest.raises(UsageError, match="-1 episodes"):
        write_report(runs, tmp_path / "new.html", episodes=-1)

    def fails(*_):
        raise OSError("disk full")

    monkeypatch.setattr("drivax.files.os.fsync", fails)
    with pytest.raises(OSError, match="disk full"):
        write_report(runs, out, overwrite=True)
    assert out.read_bytes() == before and [path.name for path in out.parent.iterdir()] == ["report.html"]


def test_equal_runs_give_equal_pages(runs, tmp_path):
    pages = [write_report(runs, tmp_path / f"{name}.html").read_bytes() for name in "ab"]
    assert pages[0] == pages[1]


def test_report_of_trainings_or_one_planner_alone(runs, tmp_path):
    alone = Page(write_report([runs[-1]], tmp_path / "training.html").read_text())
    assert "Learning curves" in alone.text and "Results" not in alone.text
    single = Page(write_report([runs[2]], tmp_path / "single.html").read_text())
    assert "Results" in single.text and "against the others" not in single.text


def crash(folder, number, step, error):
    """Write a crash of the planner into a run folder."""
    header, *rows = (folder / "episodes.csv").read_text().splitlines()
    rows = [f"{row},{int(place == number)}" for place, row in enumerate(rows)]
    (folder / "episodes.csv").write_text("\n".join([f"{header},crashed", *rows]) + "\n")
    row = {"dataset": "hand", "scenario_id": f"hand-{number:02d}", "step": step, "error": error}
    (folder / "crashes.json").write_text(json.dumps([row]))


def test_crashes_are_shown_with_step_and_error(runs, tmp_path):
    before = Page(write_report(runs, tmp_path / "before.html").read_text())
    assert not any("crashed" in cell for cell in before.tables[0][0]), "nobody crashed"
    crash(runs[2], 2, 55, "ValueError: too <fast>")
    page = Page(write_report(runs, tmp_path / "report.html").read_text())
    assert page.tables[0][0][1].startswith("crashed") and page.tables[0][3][1].startswith("12.5 %")
    data = [json.loads(text) for attrs, text in page.scripts if attrs.get("type") == "application/json"]
    *_, episode, listed = [one for one in data if one.get("id", "hand-02") == "hand-02"]
    assert listed["runs"][2]["errors"] == {"0": [55, "ValueError: too <fast>"]}, "it is the gravest failure"
    assert (
        episode["rollouts"][2]["events"] == {"crashed": 55} and episode["title"] == "hand-02: planner crashed"
    )
    assert episode["rollouts"][0]["events"] == {}


@needs_browser
def test_crash_error_is_the_title_of_its_cell(runs, tmp_path):
    crash(runs[2], 2, 55, "ValueError: too <fast>")
    with np.load(runs[2] / "trajectories.npz") as stored:
        arrays = dict(stored)
    arrays["ego"][2, 46:] = np.nan
    np.savez(runs[2] / "trajectories.npz", **arrays)
    act = """
      const cell = document.querySelector("#rows tr td");
      const scrub = document.querySelector("[data-control=scrub]");
      scrub.value = 60; scrub.dispatchEvent(new Event("input"));
      const [note, speed] = [".note", ".speed"].map((name) => (
        document.querySelector(`figure.pane:last-child ${name}`).textContent));
      document.title = JSON.stringify([cell.textContent, cell.title, note, speed]);"""
    dom = browse(acted(write_report(runs, tmp_path / "report.html"), act), tmp_path, "--dump-dom")
    found = json.loads(unescape(re.search(r"<title>(.*?)</title>", dom)[1]))
    note = "✕ planner crashed at 5.5 s"
    assert found == ["planner crashed", "step 55: ValueError: too <fast>", note, "gone"]


def react(run):
    """Store reactive traffic: slot 1 stands still left of ego's start, no other agent is present."""
    with np.load(run / "trajectories.npz") as stored:
        arrays = dict(stored)
    others = np.full((*arrays["ego"].shape[:2], 2, 3), -32768, np.int16)
    others[:, :, 1] = 0, 500, 0
    np.savez(run / "trajectories.npz", **arrays, others=others)


def test_reactive_agents_are_those_of_the_last_run(runs, tmp_path):
    for run in runs[:3]:
        react(redescribe(run, traffic="idm"))
    page = Page(write_report(runs, tmp_path / "report.html").read_text())
    assert "Other agents are drawn as they moved around policy;" in page.text
    episode = json.loads(next(text for kind, text in page.scripts if kind.get("class") == "episode"))
    pose = np.frombuffer(base64.b64decode(episode["agents"]["pose"]), "<i2").reshape(-1, episode["steps"], 3)
    place = pose[0, 11:, :2] * episode["unit"] + episode["centre"]
    np.testing.assert_allclose(place, [[0.0, 10.0]] * len(place), atol=episode["unit"])
    assert (pose[1:, 11:] == ABSENT).all()
    alone = Page(write_report(runs[2:3], tmp_path / "alone.html").read_text())
    assert "Other agents are drawn" not in alone.text


def test_runs_in_other_traffic_are_not_compared(runs, tmp_path):
    redescribe(runs[0], traffic="idm")
    with pytest.raises(DataError, match=r"lacks 'others'"):
        read_runs(runs)
    react(runs[0])
    parsed = Page(write_report(runs, tmp_path / "report.html").read_text())
    said = "expert and policy differ in traffic (idm and log)."
    assert said in parsed.text and "constant and policy" not in parsed.text
    assert all(row[1] == "no pairs: differ in traffic (log and idm)" for row in parsed.tables[2][1:])


def test_page_names_runs_with_other_starts_or_fewer_scenarios(runs, tmp_path):
    """A noisy run from another step makes no pairs; one of two of the eight scenarios makes two."""
    (runs[0] / "config.yaml").write_text("noisy_start: true\nstart_step: 40\n")
    (runs[2] / "config.yaml").write_text("noisy_start: false\nstart_step: 10\n")
    lines = (runs[1] / "episodes.csv").read_text().splitlines()
    (runs[1] / "episodes.csv").write_text("\n".join(lines[:3]) + "\n")
    page = Page(write_report(runs, tmp_path / "report.html").read_text())
    assert (
        "expert and policy differ in noisy_start (True and False); "
        "constant and policy have 2 of 2 and 8 scenarios in common." in page.text
    )
    assert all("no pairs" in row[1] and "no pairs" not in row[2] for row in page.tables[2][1:])
    drives = [json.loads(t)["rollouts"] for a, t in page.scripts if a.get("class") == "episode"]
    assert {one["planner"] for episode in drives for one in episode} == {"constant", "policy"}


def test_report_command_writes_pages_and_reports_errors_in_one_line(runs, tmp_path, capsys):
    assert main(["report", *map(str, runs), "--out", str(tmp_path / "r.html"), "--episodes", "2"]) == 0
    assert "r.html" in capsys.readouterr().out
    assert main(["report", *map(str, runs[:3])]) == 0 and (runs[2] / "report.html").is_file()
    assert main(["report", str(runs[0]), "--out", str(tmp_path / "r.html")]) == 2
    assert main(["report", str(tmp_path / "nowhere")]) == 1
    assert main(["report"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 3 and all(line.startswith("drivax: ") for line in lines)


@needs_browser
def test_player_works_in_a_browser(runs, tmp_path, scenarios):
    """No errors, one canvas per planner, and the displayed numbers of a step are the stored ones."""
    html = write_report(runs, tmp_path / "report.html")
    act = """
      const key = (name) => document.body.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
      document.getElementById("stage").scrollIntoView();
      const scrub = document.querySelector("[data-control=scrub]");
      scrub.value = 44; scrub.dispatchEvent(new Event("input")); key("ArrowRight");"""
    dom = browse(acted(html, act), tmp_path, "--dump-dom", "--window-size=1280,1000")
    tag = re.search(r"<html[^>]*>", dom)[0]
    assert 'data-panes="3"' in tag and "data-error" not in tag
    speeds = re.findall(r'class="speed">([\d.]+) m/s', dom)
    logged = float(np.linalg.norm(scenarios[1].agent_velocity[45, 0]))
    assert [float(speed) for speed in speeds] == pytest.approx([logged] * 3, abs=0.051)
    assert ">4.5 s / 9.0 s<" in dom, "scrubbed to step 44, then one step on by the arrow key"
    assert dom.count("✕ collision at 4.0 s") == 1, "only the policy collided, and that was half a second ago"


@needs_browser
@pytest.mark.parametrize("width", [1280, 520])
def test_canvases_are_not_empty(runs, tmp_path, width):
    imread = pytest.importorskip("matplotlib.image").imread
    html = write_report(runs[:3], tmp_path / "report.html")
    # Only the canvases are left to show these colours.
    hidden = "table, #plots, .legend, .ticks, .charts { display: none !important; }</style>"
    html.write_text(html.read_text().replace("</style>", hidden))
    shot = tmp_path / "shot.png"
    browse(
        html,
        tmp_path,
        f"--screenshot={shot}",
        f"--window-size={width},2400",
        "--blink-settings=preferredColorScheme=1",
    )
    image = np.round(imread(shot)[..., :3] * 255).astype(int)
    for name in ("ego", "vehicle", "edge", "red", "parked"):
        wanted = [int(LIGHT[name][i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(image - wanted).max(axis=-1) <= 2).sum() > 60, name


def test_provenance_names_the_data_of_a_training():
    training = TrainingCurves(
        Path("a"), "ppo", {"data": [{"path": "sets/a", "hash": "0123456789abcdef"}]}, {}
    )
    assert "sets/a 0123456789ab<" in _provenance([training])
