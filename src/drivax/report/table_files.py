"""Tables of evaluations as CSV (with all digits), Markdown and LaTeX files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from drivax.errors import UsageError, did_you_mean
from drivax.evaluation import result_tables
from drivax.evaluation.episode_table import ADDED, EpisodeTable, Tags
from drivax.evaluation.pairing import comparable
from drivax.files import check_output, inside, write_text
from drivax.metrics.catalogue import METRICS, SETS
from drivax.report.episodes import EvaluatedSet
from drivax.report.runs import read_evaluations
from drivax.table import Table

#: Columns of the tables by tag, few enough for a page.
KEY_METRICS = (
    "success", "accuracy", "collision", "at_fault_collision", "offroad", "red_light", "progress_ratio", "vmax_score",
)  # fmt: skip
#: Metrics of a transfer matrix.
TRANSFER_METRICS = ("success", "vmax_score")


def write_tables(
    runs: Sequence[Path], out: Path, data: Path | None = None, overwrite: bool = False, metrics: Sequence[str] = ()
) -> list[Path]:  # fmt: skip
    """Write every table of a report into a folder as ``.csv``, ``.md`` and ``.tex``, and return the files.

    The tables are ``results``, ``differences`` (several runs; columns for those that are comparable with the policy),
    ``collisions`` (known kinds of collision), ``by-TAG`` (:func:`strata_tables`) and ``transfer-METRIC`` (runs on
    several data sets).

    Args:
        runs: Run folders; the last evaluation is the policy.
        out: Folder of the tables.
        data: Path of the policy's scenario set, if it has moved.
        overwrite: Replace existing files.
        metrics: Extra columns of ``episodes.csv``, or sets of metrics, for ``results``, ``differences`` and ``by-TAG``.

    Raises:
        DataError: A run folder or the scenario set is missing or damaged, the set is not the evaluated one, or a file
            in ``out`` is a symbolic link.
        UsageError: A file exists, no run is an evaluation, or no run has one of the metrics.
    """
    texts = {}
    for table in _tables(read_evaluations(runs), data, metrics):
        formats = {"csv": table.csv(), "md": table.markdown(), "tex": table.latex()}
        texts |= {f"{table.name}.{suffix}": text for suffix, text in formats.items()}
    files = {inside(out, name): text for name, text in texts.items()}
    for file in files:
        check_output(file, overwrite)
    for file, text in files.items():
        write_text(file, text)
    return list(files)


def select_metrics(runs: Sequence[EpisodeTable], extra: Sequence[str] = ()) -> list[str]:
    """Return the metrics of the files: headline metrics, progress in metres, user-defined metrics, and ``extra``.

    ``extra`` has names of metrics and of sets of metrics. Runs without any of these metrics have all of theirs.

    Raises:
        UsageError: ``extra`` names no set, and no metric of which a run has a mean.
    """
    names = result_tables.sort_metrics(result_tables.metric_names(runs))
    selected = {"progress"}
    for entry in extra:
        if entry not in SETS and entry not in names:
            raise UsageError(f"no run has a mean of {entry!r}", cure=did_you_mean(entry, [*SETS, *names]))
        selected.update(SETS.get(entry, (entry,)))
    headline = result_tables.headline_names(names)
    others = [name for name in names if name in selected or name not in (*METRICS, *ADDED)]
    return [*headline, *(name for name in others if name not in headline)] or names


def _tables(runs: Sequence[EpisodeTable], data: Path | None, extra: Sequence[str]) -> list[Table]:
    """Return all tables in the order of the files."""
    default_metrics, metrics = select_metrics(runs), select_metrics(runs, extra)
    results = [result_tables.results_table(runs, metrics)]
    if len(runs) > 1:
        others = [run for run in runs[:-1] if comparable(runs[-1], run)]
        results.append(result_tables.differences_table(runs[-1], others, metrics))
    if any("collision_type" in run.metrics for run in runs):
        results.append(result_tables.collisions_table(runs))
    extra_metrics = [name for name in metrics if name not in default_metrics]
    results += strata_tables(runs, EvaluatedSet(runs[-1], data).tags(), extra_metrics)
    return results + transfer_tables(runs)


def strata_tables(runs: Sequence[EpisodeTable], tags: Tags, extra: Sequence[str] = ()) -> list[Table]:
    """Return a table for each tag of ``result_tables.STRATA`` that the scenarios have, of the runs on these scenarios.

    Columns are :data:`KEY_METRICS` and ``extra``.
    """
    runs = [run for run in runs if any(key in tags for key in run.scenarios)]
    tag_names = {name for scenario_tags in tags.values() for name in scenario_tags}
    names = dict.fromkeys((*KEY_METRICS, *extra))
    metrics = [name for name in names if any(name in run.metrics for run in runs)]
    strata = [tag for tag in result_tables.STRATA if tag in tag_names]
    return [result_tables.strata_table(runs, tags, tag, metrics) for tag in strata]


def transfer_tables(runs: Sequence[EpisodeTable]) -> list[Table]:
    """Return a matrix of training and evaluation data for each defined metric of :data:`TRANSFER_METRICS`.

    There is no table if all runs share one set.
    """
    if len({result_tables.set_key(run.data) for run in runs}) < 2:
        return []
    metrics = [name for name in TRANSFER_METRICS if any(result_tables.summarise(run, name).n for run in runs)]
    return [result_tables.transfer_table(runs, name) for name in metrics]
