"""``drivax compare``: text, JSON, page, and exit status."""

from __future__ import annotations

import csv
import json
import re
import shutil

import jsonschema
import pytest

from drivax import settings
from drivax.cli import main
from drivax.evaluation.comparison import ComparisonPlan

from .conftest import redescribe
from .test_report import Page

PLAN = "primary: progress_ratio\nsecondary: [collision, offroad, red_light]\nminimum_scenarios: 4\nresamples: 200\n"
MAYBE = {"type": ["number", "null"]}
INTERVAL = {
    "type": "object",
    "required": ["mean", "low", "high", "n"],
    "properties": {"mean": MAYBE, "n": {"type": "integer"}},
}
METRIC = {
    "type": "object",
    "required": [
        "metric", "unit", "better", "a", "b", "difference", "effects", "evidence", "p_adjusted", "winner", "seeds",
        "undefined_a", "undefined_b",
    ],
    "properties": {"a": INTERVAL, "b": INTERVAL, "difference": INTERVAL, "winner": {"enum": ["A", "B", None]}},
}  # fmt: skip
SCHEMA = {
    "type": "object",
    "required": [
        "plan", "names", "folders", "traffic", "scenarios", "recordings", "strata", "primary", "secondary",
        "sensitivity", "seeds", "decision",
    ],
    "properties": {
        "primary": METRIC,
        "secondary": {"type": "array", "items": METRIC},
        "decision": {
            "type": "object",
            "required": ["recommendation", "because", "needed", "caveats"],
            "properties": {"recommendation": {"enum": ["A", "B", "no difference", "not enough scenarios"]}},
        },
    },
}  # fmt: skip


@pytest.fixture
def plan(tmp_path):
    file = tmp_path / "plan.yaml"
    file.write_text(PLAN)
    return file


def called(capsys, *arguments):
    status = main(["compare", *map(str, arguments)])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_text_has_conditions_tables_and_recommendation(runs, plan, capsys):
    status, out, _ = called(capsys, runs[2], runs[1], "--config", plan)
    lines = out.splitlines()
    assert status == 0 and max(map(len, lines)) <= 100
    assert lines[0].startswith("A  policy") and lines[1].startswith("B  constant")
    assert "paired on 8 scenarios of 4 recordings, log traffic" in out
    # The policy is better by 0.1 in every scenario: the rarest of the 2^4 sign patterns, twice.
    row = next(line for line in lines if line.startswith("progress ↑"))
    assert row.split()[:5] == ["progress", "↑", "0.825", "0.725", "+0.100"]
    assert " 0.125 " in row and "red light ↓" in out
    assert re.search(r"undefined for A in 3, for B in 3", out)
    assert "recommendation: not enough scenarios" in lines


def test_equal_means_are_not_called_lower(runs, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(runs[2], copy)
    _, out, _ = called(capsys, runs[2], copy, "--primary", "progress_ratio", "--secondary", "[]")
    assert (
        "Progress has the same mean for A and B (all equal, p = 1.000)" in out and "lower with A" not in out
    )


def test_runs_in_folders_of_the_same_name_have_distinct_names(runs, plan, tmp_path, capsys):
    copies = [tmp_path / name / "test" for name in ("a", "b")]
    for copy in copies:
        shutil.copytree(runs[2], copy)
    _, out, _ = called(capsys, *copies, "--config", plan, "--json")
    assert json.loads(out)["names"] == ["policy (a/test)", "policy (b/test)"]


def test_json_equals_the_csv_files(runs, plan, capsys):
    status, out, _ = called(capsys, runs[2], runs[1], "--config", plan, "--json")
    found = json.loads(out)
    jsonschema.validate(found, SCHEMA)
    columns = []
    for folder in (runs[2], runs[1]):
        with (folder / "episodes.csv").open() as file:
            columns.append([row["red_light"] for row in csv.DictReader(file)])
    pairs = [float(a) - float(b) for a, b in zip(*columns, strict=True) if a and b]
    red = found["secondary"][2]
    assert status == 0 and red["metric"] == "red_light" and red["difference"]["n"] == len(pairs)
    assert red["difference"]["mean"] == pytest.approx(sum(pairs) / len(pairs))
    assert found["names"] == ["policy", "constant"] and found["plan"]["minimum_scenarios"] == 4


def test_page_is_self_contained(runs, plan, tmp_path, capsys):
    page = tmp_path / "out" / "comparison.html"
    status, out, _ = called(capsys, runs[2], runs[1], "--config", plan, "--html", page)
    assert status == 0 and f"wrote {page}" in out
    html = page.read_text()
    parsed = Page(html)
    assert not parsed.links and "url(" not in html and "@import" not in html and "default-src 'none'" in html
    assert not re.search(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}/", html)
    assert "Recommendation: not enough scenarios" in parsed.text
    primary, secondary, _ = parsed.tables
    assert len(primary) == 2 and len(secondary) == 4 and secondary[0][6] == "p (Holm)"
    assert primary[1][0] == "progress ↑" and primary[1][3].startswith("+0.100|")
    assert secondary[1][1].startswith("25.0 %|") and html.count("<svg") == html.count("</svg>") > 0
    assert called(capsys, runs[2], runs[1], "--config", plan, "--html", page)[0] == 2
    assert called(capsys, runs[2], runs[1], "--config", plan, "--html", page, "--overwrite")[0] == 0


def test_save_writes_the_plan_and_config_runs_it(runs, tmp_path, capsys):
    file = tmp_path / "plans" / "plan.yaml"
    words = (
        "--primary",
        "accuracy",
        "--secondary",
        "[collision]",
        "--minimum_scenarios",
        "8",
        "--save",
        file,
    )
    status, out, _ = called(capsys, runs[0], runs[1], *words)
    assert status == 0 and out == f"wrote {file}\n"
    assert settings.load(ComparisonPlan, file) == ComparisonPlan(
        a=runs[0], b=runs[1], primary="accuracy", secondary=("collision",), minimum_scenarios=8
    )
    assert called(capsys, *words)[0] == 2, "nothing is overwritten"
    status, out, _ = called(capsys, "--config", file)
    assert status == 0 and "A  expert" in out and "accuracy ↑" in out
    # A primary metric is no secondary one, though it is one of those by default.
    usual = ComparisonPlan().secondary
    file = tmp_path / "collision.yaml"
    assert called(capsys, "--primary", usual[0], "--save", file)[0] == 0
    assert settings.load(ComparisonPlan, file).secondary == usual[1:]


def test_random_and_stratified_splits_are_reported(runs, plan, capsys):
    words = ("--primary", "accuracy", "--secondary", "[progress_ratio]", "--minimum_scenarios", "2")
    status, out, _ = called(capsys, runs[0], runs[1], *words, "--split", "random")
    assert status == 0 and "split at random: 4 scenarios of 2 recordings for A, 4 of 2 for B" in out
    plan.write_text(PLAN + "split: stratified\nstrata: [dataset]\n")
    status, out, _ = called(capsys, runs[0], runs[1], "--config", plan)
    assert status == 0 and "split within 1 stratum" in out


def test_seeds_of_one_folder_are_averaged(runs, plan, tmp_path, capsys):
    seeds = tmp_path / "seeds"
    for number, run in enumerate(runs[1:3]):
        folder = seeds / f"seed-{number}"
        folder.mkdir(parents=True)
        for name in ("run.json", "episodes.csv"):
            shutil.copy(run / name, folder)
        redescribe(folder, planner=f"seed-{number}")
    status, out, _ = called(capsys, seeds, runs[0], "--config", plan)
    assert status == 0 and "A  seeds" in out
    assert "A, seeds: 2 seeds: 0.725, 0.825; interquartile mean 0.775" in out


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["A"], 2, "1 runs are named"),
        ([], 2, "no runs are named"),
        (["A", "MISSING"], 1, "run folder not found"),
        (["A", "TRAINING"], 1, "not evaluation"),
        (["A", "A"], 2, "the same run"),
        (["A", "B", "--primary", "succes"], 2, "did you mean 'success'?"),
        (["A", "B", "--config", "MISSING.yaml"], 2, "file not found"),
        (["A", "B", "--html", "FOLDER"], 2, "name a file to write"),
        (["--save", "FOLDER"], 2, "name a file to write"),
    ],
)
def test_wrong_calls_print_one_line(arguments, status, words, runs, tmp_path, capsys):
    places = {
        "A": runs[0], "B": runs[1], "TRAINING": runs[3], "MISSING": tmp_path / "m", "FOLDER": tmp_path,
        "MISSING.yaml": tmp_path / "m.yaml",
    }  # fmt: skip
    found, out, err = called(capsys, *(places.get(word, word) for word in arguments))
    assert (found, out) == (status, "") and err.count("\n") == 1 and words in err
