"""Tables with a renderer for each output: terminal, Markdown, HTML, LaTeX, and CSV with all digits."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from drivax.escaping import csv_text, escape_controls
from drivax.stats.intervals import Interval

if TYPE_CHECKING:
    from rich.table import Table as RichTable

#: Text of a missing number.
MISSING = "–"
#: Columns of an interval in a CSV file.
_INTERVAL_COLUMNS = ("metric", "mean", "low", "high", "n")


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        heading: Heading, with unit and direction.
        key: Name in CSV files; by default the heading.
        label: Whether its cells are row headings, which are never wrapped.
        left: Whether to align text left in a terminal, as labels are.
        title: Tooltip in HTML.
        max_width: Maximum width in a terminal, characters.
        picture: Whether its cells are pictures, which only HTML shows.
    """

    heading: str
    key: str = ""
    label: bool = False
    left: bool = False
    title: str = ""
    max_width: int | None = None
    picture: bool = False


@dataclass(frozen=True)
class Cell:
    """A cell.

    Attributes:
        text, bounds, note: Text, formatted interval, and a note in small print (not in a terminal).
        interval, metric: The number behind the text with its metric, for CSV files.
        mark: A verdict next to the text, in HTML.
        style: CSS class; ``group`` makes a bold row in a terminal.
        title: Tooltip in HTML.
        link: Filter of the page's list of episodes when the number is clicked.
        html: A picture.
    """

    text: str = MISSING
    bounds: str = ""
    note: str = ""
    interval: Interval | None = None
    metric: str = ""
    mark: str = ""
    style: str = ""
    title: str = ""
    link: Mapping[str, Any] | None = None
    html: str = ""


@dataclass(frozen=True)
class Table:
    """Cells under headings, with a renderer for every output.

    Attributes:
        name: Name of its file, and CSS class.
        rows: One cell per column in each row.
        caption: One line about the numbers.
        across: Quantity that distinguishes the columns of numbers in a CSV file: ``metric``, ``planner``, ...
    """

    name: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""
    across: str = "metric"

    def rich(self, *below: Table) -> RichTable:
        """Return a table for a terminal, with the tables ``below`` it in columns of the same widths."""
        from rich.table import Table as RichTable

        visible = [i for i, column in enumerate(self.columns) if not column.picture]
        has_headings = any(self.columns[i].heading for i in visible)
        grid = RichTable(
            box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0), show_header=has_headings
        )
        for column in (self.columns[i] for i in visible):
            grid.add_column(
                escape_controls(column.heading), no_wrap=column.label,
                justify="left" if column.label or column.left else "right",
                max_width=column.max_width, overflow="ellipsis" if column.label else "fold",
                style="bold" if column.label and not has_headings else "",
            )  # fmt: skip
        for table in (self, *below):
            if table is not self:
                grid.add_row()
                grid.add_row(*(escape_controls(table.columns[i].heading) for i in visible), style="bold")
            for row in table.rows:
                texts = (map(escape_controls, filter(None, (row[i].text, row[i].bounds))) for i in visible)
                grid.add_row(*map("\n".join, texts), style="bold" if row[0].style == "group" else "")
        return grid

    def text(self, *below: Table, width: int = 100) -> str:
        """Return plain text of at most ``width`` columns; see :meth:`rich`."""
        from rich.console import Console

        stream, grid = io.StringIO(), self.rich(*below)
        console = Console(file=stream, width=width, highlight=False, markup=False, emoji=False)
        if console.measure(grid, options=console.options.update(width=10 * width)).maximum > width:
            # One blank between columns, so that no heading is split within a word.
            grid.padding = (0, 1, 0, 0)
        console.print(grid)
        return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())

    def markdown(self) -> str:
        """Return Markdown: number, interval and n in each cell."""
        lines = [
            _markdown_row([column.heading for column in self.columns]),
            _markdown_row(["---" if column.label else "---:" for column in self.columns]),
            *(_markdown_row([" ".join(_cell_texts(cell)) for cell in row]) for row in self.rows),
        ]
        caption = f"{_escape_markdown(self.caption)}.\n\n" if self.caption else ""
        return caption + "\n".join(lines) + "\n"

    def latex(self) -> str:
        r"""Return a ``tabular`` to ``\input``; it needs no package."""
        align = "".join("l" if column.label else "r" for column in self.columns)
        headings = " & ".join(escape_latex(column.heading) for column in self.columns)
        rows = (" & ".join(_latex_cell(_cell_texts(cell)) for cell in row) for row in self.rows)
        caption = f"% {re.sub(r'[^ -~]', '-', self.caption)}"
        header = [caption, rf"\begin{{tabular}}{{{align}}}", r"\hline", rf"{headings} \\", r"\hline"]
        lines = [*header, *(rf"{row} \\" for row in rows), r"\hline", r"\end{tabular}"]
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Return one line per number: labels, ``across`` unless it is ``metric``, metric, mean, low, high, n.

        Undefined numbers are empty.
        """
        labels = [i for i, column in enumerate(self.columns) if column.label and column.key != "metric"]
        keys = [self.columns[i].key or self.columns[i].heading for i in labels]
        keys += [] if self.across == "metric" else [self.across]
        lines: list[list[Any]] = [[*(key.replace(" ", "_") for key in keys), *_INTERVAL_COLUMNS]]
        for row in self.rows:
            for column, cell in zip(self.columns, row, strict=True):
                if (interval := cell.interval) is not None:
                    row_labels = [row[i].text for i in labels]
                    row_labels += [] if self.across == "metric" else [column.key or column.heading]
                    numbers = (interval.mean, interval.low, interval.high)
                    digits = ("" if value is None else repr(value) for value in numbers)
                    lines.append([*row_labels, cell.metric, *digits, interval.n])
        return csv_text(lines)

    def html(self) -> str:
        """Return HTML that scrolls horizontally on narrow screens."""
        headings = "".join(
            f"<th scope=col{_attribute('title', column.title)}>{escape(column.heading)}</th>"
            for column in self.columns
        )
        head = f"<thead><tr>{headings}</tr></thead>" if any(column.heading for column in self.columns) else ""
        rows = "".join(f"<tr>{''.join(map(_html_cell, self.columns, row))}</tr>" for row in self.rows)
        return (
            f'<div class=scroll tabindex=0 role=region aria-label="{escape(self.name)}"><table class="'
            f'{escape(self.name)}">{head}<tbody>{rows}</tbody></table></div>'
        )


def interval_cell(
    interval: Interval, unit: str, metric: str = "", signed: bool = False, **fields: Any
) -> Cell:
    """Return the cell of an estimate: mean, interval and n; ``signed`` for a difference."""
    if interval.mean is None:
        fields = {"style": "undefined", "title": "undefined in every episode"} | fields
        return Cell(note="n 0", interval=interval, metric=metric, **fields)
    mean = number(interval.mean, unit, signed) + suffix(unit, signed)
    return Cell(mean, bounds(interval, unit, signed), f"n {interval.n}", interval, metric, **fields)


def number(value: float | None, unit: str, signed: bool = False) -> str:
    """Format a number for tables, with a plus sign if ``signed``.

    The unit is ``rate`` (percent, one decimal), ``share`` (three decimals), or a physical unit (two decimals below 10,
    one below 1,000, then none).
    """
    if value is None:
        return MISSING
    sign = "+" if signed else ""
    if unit == "rate":
        text = f"{100 * value:{sign}.1f}"
    elif unit == "share":
        text = f"{value:{sign}.3f}"
    else:
        digits = 2 if abs(value) < 10 else 1 if abs(value) < 1000 else 0
        text = f"{value:{sign}.{digits}f}"
    if not any(digit in text for digit in "123456789"):
        text = text.lstrip("+-")
    return text.replace("-", "−")


def suffix(unit: str, signed: bool = False) -> str:
    """Return the unit after a number: percent for rates, points for differences of rates."""
    return "" if unit != "rate" else " points" if signed else " %"


def bounds(interval: Interval, unit: str, signed: bool = False) -> str:
    """Format an interval as ``low–high``, or as ``low to high`` if the dash could be read as a sign.

    An interval without width is ``all equal``, and a mean without bounds has ``no interval``.
    """
    if interval.low is None or interval.high is None:
        return "no interval" if interval.n else ""
    if interval.low == interval.high:
        return "all equal"  # a bootstrap of equal values has no width, which is not certainty
    low, high = number(interval.low, unit, signed), number(interval.high, unit, signed)
    separator = " to " if signed or "−" in low + high else "–"
    return f"{low}{separator}{high}"


def _cell_texts(cell: Cell) -> list[str]:
    """Return the texts of a cell for Markdown and LaTeX, the interval in brackets."""
    if cell.interval is None:
        return [cell.text]
    if cell.interval.mean is None:
        return [cell.text, cell.note]
    return [cell.text, f"({cell.bounds})", cell.note]


def _attribute(name: str, value: str) -> str:
    return f' {name}="{escape(value)}"' if value else ""


def _html_cell(column: Column, cell: Cell) -> str:
    title = _attribute("title", cell.title)
    lines = [text for text in (cell.bounds, cell.note) if text]
    lines = [", ".join(lines)] if cell.mark else lines
    notes = "".join(f"<small>{escape(text)}</small>" for text in lines)
    if column.label:
        return f"<th scope=row{title}>{escape(cell.text)}{notes}</th>"
    link = "" if cell.link is None else _attribute("data-link", json.dumps(cell.link))
    mark = f"<em>{escape(cell.mark)}</em>" if cell.mark else ""
    text = f"<b>{escape(cell.text)}</b>" if cell.bounds or cell.link is not None else escape(cell.text)
    style = _attribute("class", cell.style)
    return f"<td{style}{title}{link}>{cell.html or text}{mark}{notes}</td>"


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(map(_escape_markdown, cells)) + " |"


def _escape_markdown(text: str) -> str:
    """Escape plain text for a cell of a Markdown table."""
    return re.sub(r"([\\`*_~\[\]<|])", r"\\\1", text.replace("\n", " ").replace("&", "&amp;"))


def _latex_cell(texts: Sequence[str]) -> str:
    first, *rest = map(escape_latex, texts)
    lines = r" \\ ".join([first, *(rf"\scriptsize {text}" for text in rest)])
    return rf"\shortstack[r]{{{lines}}}" if rest else first


_LATEX: Mapping[str, str] = MappingProxyType(
    {
        "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
        "[": "{[}", "*": "{*}",  # after the end of a row they would belong to it
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
        "|": r"\textbar{}", '"': "''", "−": r"$-$", "–": "--", "²": "$^2$", "³": "$^3$", "±": r"$\pm$",
        "↑": r"$\uparrow$", "↓": r"$\downarrow$", "“": "``", "”": "''", "’": "'", "≥": r"$\geq$", "≤": r"$\leq$",
    }
)  # fmt: skip


def escape_latex(text: str) -> str:
    """Escape plain text for LaTeX, with code points for characters that its fonts lack."""
    # Every LaTeX font has the letters of Latin-1, but not control characters, emoji or other scripts.
    latin = re.compile("[ -~À-ÖØ-öø-ÿ]")
    return "".join(
        _LATEX.get(letter) or (letter if latin.match(letter) else rf"\texttt{{U+{ord(letter):04X}}}")
        for letter in text
    )
