"""One table in every output, against strings by hand."""

from __future__ import annotations

import pytest

from drivax.stats.intervals import UNDEFINED, Interval
from drivax.table import Cell, Column, Table, bounds, escape_latex, interval_cell, number


@pytest.mark.parametrize(
    ("value", "unit", "signed", "text"),
    [
        (0.625, "rate", False, "62.5"), (-0.0417, "rate", True, "−4.2"), (0.0, "rate", True, "0.0"),
        (-0.0001, "rate", True, "0.0"), (0.9, "share", False, "0.900"), (0.25, "share", True, "+0.250"),
        (3.14159, "m", False, "3.14"), (31.4159, "m", False, "31.4"), (31415.9, "m", False, "31416"),
        (None, "m", False, "–"),
    ],
)  # fmt: skip
def test_number_has_the_digits_of_its_unit(value, unit, signed, text):
    assert number(value, unit, signed) == text


def test_bounds_are_words_where_there_is_no_interval():
    assert bounds(Interval(0.5, 0.25, 0.75, 4), "rate") == "25.0–75.0"
    assert bounds(Interval(-0.5, -0.75, 0.25, 4), "rate", signed=True) == "−75.0 to +25.0"
    assert bounds(Interval(-1.0, -2.0, 1.5, 4), "m") == "−2.00 to 1.50"
    assert bounds(Interval(1.0, None, None, 1), "m") == "no interval"
    assert bounds(Interval(1.0, 1.0, 1.0, 9), "m") == "all equal" and bounds(UNDEFINED, "m") == ""


def test_latex_escapes_special_characters():
    assert escape_latex("a_b & 5 %") == r"a\_b \& 5 \%"
    assert escape_latex("[0.5]") == "{[}0.5]", "behind the end of a row a bracket would begin an option"
    assert escape_latex("*") == "{*}", "behind the end of a row a star would belong to it"
    assert escape_latex("−1.5 m/s²") == r"$-$1.5 m/s$^2$"
    assert escape_latex("\\x{}") == r"\textbackslash{}x\{\}"
    assert escape_latex("é😀\n") == r"é\texttt{U+1F600}\texttt{U+000A}"


COLUMNS = (Column("metric", "metric", label=True, title="what"), Column("a", "a"), Column("b|c", "b|c"))
TABLE = Table(
    "results",
    COLUMNS,
    (
        (
            Cell("success ↑"),
            interval_cell(Interval(0.5, 0.25, 0.75, 4), "rate", "success", link={"run": "a"}),
            interval_cell(UNDEFINED, "rate", "success"),
        ),
        (Cell("speed [m/s]"), interval_cell(Interval(1.5, 1.5, 1.5, 2), "m/s", "speed"), Cell()),
    ),
    "Mean",
    "planner",
)


def test_csv_has_one_line_per_number_with_all_digits():
    assert TABLE.csv().splitlines() == [
        "planner,metric,mean,low,high,n", "a,success,0.5,0.25,0.75,4", "b|c,success,,,,0", "a,speed,1.5,1.5,1.5,2",
    ]  # fmt: skip


def test_markdown_has_one_cell_per_column():
    assert TABLE.markdown().splitlines() == [
        "Mean.", "",
        "| metric | a | b\\|c |", "| --- | ---: | ---: |", "| success ↑ | 50.0 % (25.0–75.0) n 4 | – n 0 |",
        "| speed \\[m/s\\] | 1.50 (all equal) n 2 | – |",
    ]  # fmt: skip


def test_markdown_without_a_caption_is_the_table_alone():
    assert Table("x", (Column("a"),), ((Cell("1"),),)).markdown() == "| a |\n| ---: |\n| 1 |\n"


def test_latex_stacks_number_interval_and_n():
    assert (
        r"success $\uparrow$ & \shortstack[r]{50.0 \% \\ \scriptsize (25.0--75.0) \\ \scriptsize n 4}"
        in TABLE.latex()
    )
    assert TABLE.latex().startswith("% Mean\n\\begin{tabular}{lrr}\n")


def test_html_links_numbers_and_escapes_texts():
    html = TABLE.html()
    assert (
        '<td data-link="{&quot;run&quot;: &quot;a&quot;}"><b>50.0 %</b><small>25.0–75.0</small><small>n 4</small></td>'
        in html
    )
    assert '<td class="undefined" title="undefined in every episode">–<small>n 0</small></td>' in html
    assert '<th scope=col title="what">metric</th>' in html and "<th scope=row>success ↑</th>" in html
    assert "<i>" not in Table("t", (Column("<i>"),), ((Cell("<i>"),),)).html()


def test_text_aligns_numbers_right_and_puts_intervals_below():
    assert TABLE.text().splitlines() == [
        "metric               a  b|c",
        "success ↑       50.0 %    –",
        "             25.0–75.0",
        "speed [m/s]       1.50    –",
        "             all equal",
    ]


def test_tables_below_share_the_widths_of_the_first():
    lines = TABLE.text(Table("more", COLUMNS, ((Cell("x"), Cell("1"), Cell("2")),))).splitlines()
    assert lines[-3:] == ["", "metric               a  b|c", "x                    1    2"]
    assert (
        max(
            map(
                len,
                Table("t", (Column("a", label=True), Column("b", left=True)), ((Cell("x"), Cell("w " * 90)),))
                .text()
                .splitlines(),
            )
        )
        <= 100
    )


def test_wide_table_closes_up_before_it_splits_a_heading():
    headings = (
        "planner",
        "collision",
        "off-road",
        "progress",
        "comfort",
        "success",
        "accuracy",
        "red light",
        "vmax",
    )
    columns = tuple(Column(heading, label=heading == "planner") for heading in headings)
    rows = ((Cell("constant_velocity_long"), *[Cell("0.500")] * 8),)
    lines = Table("summary", columns, rows).text(width=95).splitlines()
    assert lines[0].split() == " ".join(headings).split() and len(lines) == 2
    assert "  collision" in Table("summary", columns, rows).text(width=110)
