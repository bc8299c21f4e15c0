"""Tables as files: CSV with all digits for programs, Markdown and LaTeX for people."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from drivax.errors import UsageError, did_you_mean
from drivax.evaluation.episode_table import ADDED
from drivax.evaluation.tables import Cell, Table, collisions_table, differences_table, results_table
from drivax.metrics.catalogue import METRICS, SETS
from drivax.report.breakdowns import strata_tables, transfer_tables
from drivax.report.comparison import metric_names
from drivax.report.episodes import DrivenSet
from drivax.report.glossary import ARROWS, headline, note, ordered
from drivax.report.html_tables import bounds, number, percent
from drivax.report.loaded_runs import Evaluation, read_runs
from drivax.report.pages.page import publish, refuse_page

#: Columns of a CSV file behind its labels.
_NUMBERS = ("metric", "mean", "low", "high", "n")


def write_tables(
    runs: Sequence[Path],
    out: Path,
    data: Path | None = None,
    overwrite: bool = False,
    metrics: Sequence[str] = (),
) -> list[Path]:
    """Write every table of a report into a folder, each as ``.csv``, ``.md`` and ``.tex``.

    ``results`` and, of several runs, ``differences``; ``collisions`` where kinds of collision are known; ``by-TAG`` for
    the tags of the scenarios; ``transfer-METRIC`` where runs drove several data sets.

    Args:
        runs: Run folders; the last evaluation is the policy.
        out: The folder.
        data: The scenario set that was driven, where it has moved.
        overwrite: Replace existing files.
        metrics: In ``results``, ``differences`` and ``by-TAG`` beside the usual ones: columns of ``episodes.csv``, or a
            set.

    Returns:
        The files.

    Raises:
        DataError: A run folder or the scenario set is missing, damaged, or not the one that was driven.
        UsageError: A file exists, no evaluation was given, or none has one of the metrics.
    """
    evaluations, _ = read_runs(runs)
    if not evaluations:
        raise UsageError("no evaluation was given", cure="name run folders of drivax evaluate")
    texts = {}
    for table in _tables(evaluations, data, metrics):
        texts[f"{table.name}.csv"] = csv_text(table)
        texts[f"{table.name}.md"] = markdown(table, evaluations)
        texts[f"{table.name}.tex"] = latex(table, evaluations)
    for name in texts:
        refuse_page(out / name, overwrite)
    for name, text in texts.items():
        publish(out / name, text)
    return [out / name for name in texts]


def exported(runs: Sequence[Evaluation], more: Sequence[str] = ()) -> list[str]:
    """Metrics of the files: the headline, progress in metres, those of the user's own, and what else is asked for.

    Args:
        runs: Evaluations.
        more: Columns of ``episodes.csv``, or sets of metrics.

    Raises:
        UsageError: No run has such a column.
    """
    names = ordered(metric_names(runs))
    asked = {"progress"}
    for entry in more:
        if entry not in SETS and entry not in names:
            raise UsageError(f"no run has a mean of {entry!r}", cure=did_you_mean(entry, names))
        asked.update(SETS.get(entry, (entry,)))
    first = headline(names)
    rest = [name for name in names if name in asked or name not in (*METRICS, *ADDED)]
    return [*first, *(name for name in rest if name not in first)] or names


def _tables(runs: Sequence[Evaluation], data: Path | None, asked: Sequence[str]) -> list[Table]:
    usual, metrics = exported(runs), exported(runs, asked)
    tables = [results_table(runs, metrics)]
    if len(runs) > 1:
        tables.append(differences_table(runs[-1], runs[:-1], metrics))
    if any("collision_type" in run.metrics for run in runs):
        tables.append(collisions_table(runs))
    more = [name for name in metrics if name not in usual]
    tables += strata_tables(runs, DrivenSet(runs[-1], data).tags(), more)
    return tables + transfer_tables(runs)


def csv_text(table: Table) -> str:
    """One line per number: labels, metric, mean, low, high, n; what is undefined is empty."""
    keys = [*table.keys, table.across]
    stream = io.StringIO()
    rows = csv.writer(stream, lineterminator="\n")
    rows.writerow([*(key.replace(" ", "_") for key in keys if key != "metric"), *_NUMBERS])
    for row in table.rows:
        for name, cell in zip(table.columns, row.cells, strict=True):
            if cell is not None:
                named = zip(keys, (*row.labels, name), strict=True)
                found = cell.interval
                numbers = [
                    "" if value is None else repr(value) for value in (found.mean, found.low, found.high)
                ]
                rows.writerow(
                    [*(word for key, word in named if key != "metric"), cell.metric, *numbers, found.n]
                )
    return stream.getvalue()


def markdown(table: Table, runs: Sequence[Evaluation]) -> str:
    """A table as Markdown: mean, interval and n in each cell."""
    heads = [*table.keys, *_columns(table, runs)]
    lines = [_row(heads), _row(["---"] * len(table.keys) + ["---:"] * len(table.columns))]
    for row in table.rows:
        cells = [" ".join(_parts(cell, table, runs)) for cell in row.cells]
        lines.append(_row([*_labels(row.labels, table, runs), *cells]))
    return f"{_marked(table.caption)}.\n\n" + "\n".join(lines) + "\n"


def latex(table: Table, runs: Sequence[Evaluation]) -> str:
    r"""A ``tabular`` to ``\input``; it needs no package."""
    heads = [*table.keys, *_columns(table, runs)]
    lines = [
        f"% {_comment(table.caption)}",
        rf"\begin{{tabular}}{{{'l' * len(table.keys)}{'r' * len(table.columns)}}}",
        r"\hline",
        " & ".join(map(tex, heads)) + r" \\",
        r"\hline",
    ]
    for row in table.rows:
        cells = [_stacked(_parts(cell, table, runs)) for cell in row.cells]
        lines.append(" & ".join([*map(tex, _labels(row.labels, table, runs)), *cells]) + r" \\")
    return "\n".join([*lines, r"\hline", r"\end{tabular}"]) + "\n"


_TEX: Mapping[str, str] = MappingProxyType(
    {
        "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
        "[": "{[}",  # behind the end of a row it would begin an option
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
        "|": r"\textbar{}", '"': "''", "−": r"$-$", "–": "--", "²": "$^2$", "³": "$^3$", "±": r"$\pm$",
        "↑": r"$\uparrow$", "↓": r"$\downarrow$", "“": "``", "”": "''", "’": "'", "≥": r"$\geq$", "≤": r"$\leq$",
    }
)  # fmt: skip


def tex(text: str) -> str:
    """Plain text as LaTeX; a character that its fonts lack is named by its number."""
    return "".join(
        _TEX.get(letter) or (letter if " " <= letter <= "~" else _foreign(letter)) for letter in text
    )


def _foreign(letter: str) -> str:
    # The letters of Latin-1 are in every font of LaTeX; control characters, emoji and other scripts are not.
    return letter if "À" <= letter <= "ÿ" and letter not in "×÷" else rf"\texttt{{U+{ord(letter):04X}}}"


def _comment(text: str) -> str:
    return re.sub(r"[^ -~]", "-", text)


def _stacked(parts: Sequence[str]) -> str:
    if len(parts) == 1:
        return tex(parts[0])
    return (
        r"\shortstack[r]{"
        + r" \\ ".join([tex(parts[0]), *(rf"\scriptsize {tex(one)}" for one in parts[1:])])
        + "}"
    )


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(map(_marked, cells)) + " |"


def _marked(text: str) -> str:
    """Plain text as a cell of Markdown: nothing in it is markup, an HTML element or the end of the cell."""
    return re.sub(r"([\\`*_~\[\]<|])", r"\\\1", text.replace("\n", " ").replace("&", "&amp;"))


def _heading(metric: str, runs: Sequence[Evaluation]) -> str:
    entry = note(metric, runs)
    return f"{entry.label} {ARROWS[entry.better]}".strip()


def _columns(table: Table, runs: Sequence[Evaluation]) -> list[str]:
    return [_heading(name, runs) if table.across == "metric" else name for name in table.columns]


def _labels(labels: Sequence[str], table: Table, runs: Sequence[Evaluation]) -> list[str]:
    named = zip(table.keys, labels, strict=True)
    return [_heading(label, runs) if key == "metric" else label for key, label in named]


def _parts(cell: Cell | None, table: Table, runs: Sequence[Evaluation]) -> list[str]:
    """Mean, interval in brackets, n."""
    if cell is None:
        return ["–"]
    found, unit = cell.interval, note(cell.metric, runs).unit
    if found.mean is None:
        return ["–", "n 0"]
    sign = percent(unit) if not table.signed else " points" if unit == "rate" else ""
    mean = number(found.mean, unit, table.signed) + sign
    return [mean, f"({bounds(found, unit, table.signed)})", f"n {found.n}"]
