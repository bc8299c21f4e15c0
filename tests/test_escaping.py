"""Text from files does nothing: not in a spreadsheet, not in a terminal, not in a page."""

from __future__ import annotations

import ast
import csv
import io
import random
import re
from pathlib import Path

import pytest

from drivax.errors import DataError
from drivax.escaping import csv_rows, csv_text, escape_controls, show
from drivax.report.pages.page import data_element, facts_html
from drivax.stats.intervals import Interval
from drivax.table import Cell, Column, Table, interval_cell
from drivax.tracking.progress import Progress

HOSTILE = '=HYPERLINK("http://x")\x1b]0;owned\x07\x1b[2J\u202e<script>alert(1)</script>'


def rows_of(text: str) -> list[list[str]]:
    return list(csv_rows(io.StringIO(text, newline="")))


@pytest.mark.parametrize(
    "text",
    [
        "=1+1",
        "+cmd|' /C calc'!A0",
        "-1+1",
        "@SUM(A1)",
        "\t=1",
        "\r=1",
        "\n=1",
        "'=1",
        "''@x",
        " =1",
        "\xa0 @x",
        "＝1",
        " －x",
    ],
)
def test_formulas_become_text_and_are_read_back(text):
    written = csv_text([[text, "0.5"]])
    (cells,) = csv.reader(io.StringIO(written, newline=""))
    blank, formula = (text[0], f"'{text[1:]}") if text[0] in "\t\r\n" else ("", text)
    assert cells == [f"'{blank}{formula}", "0.5"]
    assert rows_of(written) == [[text, "0.5"]]


@pytest.mark.parametrize(
    "text", ["-0.5", "+3", "-1e-05", "-.5", "-12", "", "a=b", "it's", "'quoted'", "x,y", 'say "x"']
)
def test_numbers_and_other_text_are_written_as_before(text):
    expected = io.StringIO()
    csv.writer(expected, lineterminator="\n").writerow(["x", text])
    assert csv_text([["x", text]]) == expected.getvalue()
    assert rows_of(csv_text([["x", text]])) == [["x", text]]


def test_any_cells_are_read_back_and_none_begins_a_formula():
    rng = random.Random(0)
    rows = [
        [
            "".join(rng.choices("=+-@\t\r\n'\",;|0.e a\u00e9\xa0＝＋－＠", k=rng.randrange(8)))
            for _ in range(5)
        ]
        for _ in range(2000)
    ]
    rows = [["key", *row] for row in rows]
    assert rows_of(csv_text(rows)) == rows
    for row in csv.reader(io.StringIO(csv_text(rows), newline="")):
        for cell in row:
            if cell[:1] in tuple("\t\r\n") or cell.lstrip(" \xa0")[:1] in tuple("=+-@＝＋－＠"):
                float(cell)


@pytest.mark.parametrize(
    "text",
    [
        ";=1+1",
        ",=1",
        "a|@b",
        "a\t-b",
        "a\n=1",
        ';"=1"',
        ";'=1",
        "a;;+1;=2",
        "a; =1",
        "a,\xa0@b",
        "a;＋1",
        'a;" =1"',
    ],
)
def test_formulas_after_separators_become_text(text):
    """With other separators, spreadsheets split cells in which drivax sees no separator."""
    written = csv_text([["x", text]])
    assert rows_of(written) == [["x", text]]
    for separator in ";,|\t":
        for row in csv.reader(io.StringIO(written, newline=""), delimiter=separator):
            assert all(
                cell.lstrip(" \xa0")[:1] not in tuple("=+-@＝＋－＠") for cell in row if cell.strip()
            ), row


def test_names_cannot_control_a_terminal(capsys, tmp_path):
    assert escape_controls("a\x1b[2J\n\x9b1m\u202e\udcff\x7f") == r"a\x1b[2J\n\x9b1m\u202e\udcff\x7f"
    assert escape_controls("größe · 車–\u00a0°") == "größe · 車–\u00a0°"
    table = Table("t", (Column(HOSTILE, label=True), Column("n")), ((Cell(HOSTILE + "\nB"), Cell("1")),))
    error = DataError(HOSTILE, file=tmp_path / "a\x1b[31m\nb", record="r\x07", cure="none")
    stream = io.StringIO()
    with Progress(f"evaluating {HOSTILE}[/]", "scenarios", 2, stream=stream) as bar:
        bar.update(2)
    show(f"wrote {HOSTILE}")
    texts = (table.text(width=400), str(error), stream.getvalue(), capsys.readouterr().out)
    for text in texts:
        assert "x1b]0;owned" in text or "x1b[31m" in text
        assert all(letter == "\n" or letter.isprintable() for letter in text), text
    assert "\n" not in str(error) and r"a\x1b[31m\nb: record r\x07:" in str(error)


def test_every_output_of_the_command_line_is_escaped(repository: Path):
    """Only ``show`` and tables, whose cells are escaped, write to the terminal."""
    places = []
    for file in (repository / "src" / "drivax").rglob("*.py"):
        text = file.read_text()
        for node in ast.walk(ast.parse(text)) if "print" in text else ():
            if isinstance(node, ast.Name) and node.id == "print" and file.name != "escaping.py":
                places.append(f"{file.name}:{node.lineno}")
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".print"):
                tables = all(
                    re.search(r"\.rich\(\)$|^_table\(|^grid$", ast.unparse(each)) for each in node.args
                )
                places += [] if tables else [f"{file.name}:{node.lineno}"]
    assert places == []


def test_pages_and_tables_escape_names():
    interval = Interval(0.5, 0.4, 0.6, 10)
    table = Table(
        "t", (Column("planner", label=True), Column(HOSTILE, HOSTILE)),
        ((Cell(HOSTILE, title='" onload="x'), interval_cell(interval, "rate", "success", link={"run": HOSTILE})),),
    )  # fmt: skip
    for html in (table.html(), data_element({"name": HOSTILE}), facts_html([HOSTILE], [(HOSTILE, [])])):
        assert "<script>alert" not in html and 'title="" onload' not in html
    assert rows_of(table.csv())[1][0] == HOSTILE and "\n\"'=HYPERLINK" in table.csv()
