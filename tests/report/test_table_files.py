"""Tables as files: the numbers of CSV are those of the run, Markdown has cells for all columns, LaTeX compiles."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import subprocess
from html import unescape

import pytest
from markdown_it import MarkdownIt

from drivax.cli import main
from drivax.errors import DataError, UsageError
from drivax.report.pages.report import write_report, write_tables
from drivax.table import Cell, Column, Table

from .conftest import redescribe

LATEX = next(filter(None, map(shutil.which, ("pdflatex", "xelatex", "tectonic"))), None)
NASTY = r"50% of_a & b #1 {x} $y^2$ ~ \cmd <i>|é|😀"
#: What a row may begin with, and what a renderer of Markdown could take for markup.
HARD = r"[0.5] <lambda> *a* `b` ~~c~~ \|"


@pytest.fixture
def written(runs, tmp_path):
    redescribe(runs[0], planner=NASTY)
    redescribe(runs[1], planner=HARD)
    return {file.name: file for file in write_tables(runs, tmp_path / "tables")}


@pytest.mark.parametrize("name", ["tables", "tables/results.csv", "videos", "report.html"])
def test_report_does_not_write_through_links_in_a_run(runs, tmp_path, capsys, name):
    victim, link = tmp_path / "victim", runs[0] / name
    victim.mkdir()
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(victim / "file" if "." in name else victim)
    options = {"tables": ["--tables"], "videos": ["--video", "worst:1"]}.get(name.split("/")[0], [])
    assert main(["report", str(runs[0]), *options, "--overwrite"]) == 1
    assert f"{name}: is a symbolic link; replace the link" in capsys.readouterr().err
    assert not any(victim.iterdir())


def test_each_table_has_three_files(written):
    names = {name.rsplit(".", 1)[0] for name in written}
    assert names == {"results", "differences", "collisions", "by-difficulty"} and len(written) == 12


def test_csv_equals_the_episodes_of_the_run(written, runs):
    with written["results.csv"].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["planner"] for row in rows} == {NASTY, HARD, "policy"}
    with (runs[2] / "episodes.csv").open() as file:
        episodes = list(csv.DictReader(file))
    mine = {row["metric"]: row for row in rows if row["planner"] == "policy"}
    for name in ("success", "collision", "red_light", "progress_ratio", "vmax_score"):
        values = [float(row[name]) for row in episodes if row[name] != ""]
        assert float(mine[name]["mean"]) == pytest.approx(sum(values) / len(values), abs=1e-12)
        assert int(mine[name]["n"]) == len(values)
        assert float(mine[name]["low"]) <= float(mine[name]["mean"]) <= float(mine[name]["high"])
    with written["by-difficulty.csv"].open(newline="") as file:
        strata = list(csv.DictReader(file))
    hard = next(
        r for r in strata if (r["difficulty"], r["planner"], r["metric"]) == ("hard", "policy", "collision")
    )
    assert (float(hard["mean"]), hard["n"]) == (0.5, "4"), "two of the four scenarios of odd number"
    with written["collisions.csv"].open(newline="") as file:
        kinds = {(row["first_collision"], row["planner"]): float(row["mean"]) for row in csv.DictReader(file)}
    assert kinds["rear end", "policy"] == kinds["pedestrian or cyclist", "policy"] == 1 / 8
    assert kinds["head-on", "policy"] == kinds["rear end", HARD] == 0


def test_markdown_has_a_cell_for_every_column(written):
    for name, file in written.items():
        if name.endswith(".md"):
            lines = [line for line in file.read_text().splitlines() if line.startswith("|")]
            counts = {len(re.findall(r"(?<!\\)\|", line)) for line in lines}
            assert len(counts) == 1 and len(lines) > 2, name
    assert "| progress ↑ |" in written["results.md"].read_text()
    assert "points" in written["differences.md"].read_text()


def test_markdown_renders_special_characters_as_text(written):
    for name in ("results.md", "by-difficulty.md"):
        html = MarkdownIt("gfm-like", {"linkify": False}).render(written[name].read_text())
        cells = [unescape(cell) for cell in re.findall(r"<t[hd].*?>(.*?)</t[hd]>", html)]
        assert NASTY in cells and HARD in cells, name


def test_progress_own_and_requested_metrics_are_exported(runs, tmp_path):
    for folder in runs[:3]:
        header, *rows = (folder / "episodes.csv").read_text().splitlines()
        more = [f"{row},{7 * place},0.5,{place}" for place, row in enumerate(rows)]
        text = "\n".join([f"{header},progress,ade,mine", *more])
        (folder / "episodes.csv").write_text(text + "\n")
    for metrics, expected in (((), {"progress", "mine"}), (("ade",), {"progress", "mine", "ade"})):
        write_tables(runs, tmp_path / "t", overwrite=True, metrics=metrics)
        for name in ("results", "differences"):
            with (tmp_path / "t" / f"{name}.csv").open(newline="") as file:
                found = {row["metric"]: float(row["mean"]) for row in csv.DictReader(file)}
            assert expected == {"progress", "mine", "ade"} & set(found) and "success" in found
            if name == "results":
                assert (found["progress"], found["mine"]) == (24.5, 3.5)
        by_tag = (tmp_path / "t" / "by-difficulty.md").read_text()
        assert ("ADE" in by_tag) == bool(metrics)
    write_tables(runs, tmp_path / "t", overwrite=True, metrics=("full",))
    assert "minimum TTC" in (tmp_path / "t" / "results.md").read_text()
    with pytest.raises(UsageError, match=r"mean of 'adee'.*did you mean 'ade'"):
        write_tables(runs, tmp_path / "t", overwrite=True, metrics=("adee",))


def plain(text):
    """A fragment without its escaped characters, so that what is left of special ones is markup."""
    return re.sub(r"\\[\\{}&%$#_]", "", re.sub(r"\\\\(?= |$)", "", text, flags=re.M))


def test_latex_has_balanced_braces_and_columns(written):
    for name, file in written.items():
        if not name.endswith(".tex"):
            continue
        comment, text = file.read_text().split("\n", 1)
        assert (comment.startswith("% ") and text.isascii()) or "é" in text
        rest = plain(text)
        assert (
            rest.count("{") == rest.count("}")
            and rest.count("$") % 2 == 0
            and "%" not in rest
            and "#" not in rest
        )
        columns = len(re.search(r"\\begin\{tabular\}\{(\w+)\}", text)[1])
        for line in text.splitlines():
            if line.endswith(r" \\"):
                assert len(re.findall(r"(?<!\\)&", line)) == columns - 1, (name, line)


@pytest.mark.skipif(LATEX is None, reason="no LaTeX on this machine")
def test_latex_tables_compile_with_hostile_names(written, tmp_path):
    inputs = "\n\n".join(rf"\input{{{file}}}" for name, file in written.items() if name.endswith(".tex"))
    rows = tuple((Cell(name), Cell()) for name in (NASTY, HARD, "[b]"))
    inputs += Table("names", (Column("planner", label=True), Column("success")), rows, "Names").latex()
    paper = tmp_path / "paper.tex"
    paper.write_text("\\documentclass{article}\n\\begin{document}\n" + inputs + "\n\\end{document}\n")
    command = [
        LATEX,
        *([] if "tectonic" in LATEX else ["-interaction=nonstopmode", "-halt-on-error"]),
        paper.name,
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert paper.with_suffix(".pdf").stat().st_size > 5000


def test_existing_files_and_wrong_arguments_are_refused(runs, tmp_path, hand_set, capsys):
    out = tmp_path / "tables"
    assert main(["report", *map(str, runs), "--tables", "--out", str(out)]) == 0
    assert "results.csv" in capsys.readouterr().out
    assert main(["report", *map(str, runs), "--tables", "--out", str(out)]) == 2
    assert "already exists" in capsys.readouterr().err
    assert main(["report", *map(str, runs), "--tables", "--out", str(out), "--overwrite"]) == 0
    assert main(["report", str(runs[0]), "--tables", "--video", "all"]) == 2
    assert "are mutually exclusive" in capsys.readouterr().err
    assert main(["report", str(runs[0]), "--metrics", "ade"]) == 2
    assert "pass --tables" in capsys.readouterr().err
    with pytest.raises(UsageError, match="no run folder is an evaluation"):
        write_tables(runs[3:], tmp_path / "none")
    about = json.loads((runs[2] / "run.json").read_text())
    (runs[2] / "run.json").write_text(json.dumps(about | {"data": {"path": str(tmp_path / "gone")}}))
    with pytest.raises(DataError, match="--data SET"):
        write_tables(runs, tmp_path / "moved")
    assert write_tables(runs, tmp_path / "moved", data=hand_set)


def test_transfer_table_needs_two_sets(runs, tmp_path):
    about = json.loads((runs[0] / "run.json").read_text())
    data = {"path": "elsewhere/b", "hash": "f00"}
    trained = [{"path": "elsewhere/b", "hash": "f00"}]
    (runs[0] / "run.json").write_text(json.dumps(about | {"data": data, "trained_on": trained}))
    written = {file.name: file for file in write_tables(runs, tmp_path / "tables")}
    with written["transfer-success.csv"].open(newline="") as file:
        rows = list(csv.DictReader(file))
    told = {(r["planner"], r["trained_on"], r["evaluated_on"]): float(r["mean"]) for r in rows}
    page = write_report(runs, tmp_path / "report.html").read_text()
    transfer = page[page.index("<h2>Transfer") : page.index("<h2>Kinds")]
    behind = {json.loads(unescape(found))["run"] for found in re.findall(r'data-link="(.*?)"', transfer)}
    assert behind == {"expert", "constant", "policy"}
    assert told["expert", "b", "b"] == 1.0 and math.isclose(told["policy", "–", "hand-made roads"], 3 / 8)
