"""Tables of evaluations as CSV (with all digits), Markdown and LaTeX files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from drivax.errors import UsageError, did_you_mean
from drivax.evaluation import result_tables
from drivax.evaluation.episode_table import ADDED, EpisodeTable, Tags
from drivax.evaluation.pairing import comparable
from drivax.files import check_output, write_text
from drivax.metrics.catalogue import METRICS, SETS
from drivax.report.episodes import EvaluatedSet
from drivax.report.runs import read_evaluations
from drivax.table import Table

#: Columns of a breakdown, few enough for a page.
KEY_METRICS = (
    "success", "accuracy", "collision", "at_fault_collision", "offroad", "red_light", "progress_ratio", "vmax_score",
)  # fmt: skip
#: Metrics of a transfer matrix.
TRANSFER_METRICS = ("success", "vmax_score")


def write_tables(
    runs: Sequence[Path], out: Path, data: Path | None = None, overwrite: bool = False, metrics: Sequence[str] = ()
) -> list[Path]:  # fmt: skip
    """Write every table of a report into a folder, each as ``.csv``, ``.md`` and ``.tex``; returns the files.

    The tables are ``results``; for several runs ``differences``; ``collisions`` if kinds of collision are known;
    ``by-TAG`` for the tags of the scenarios; ``transfer-METRIC`` if runs were evaluated on several data sets.

    The last evaluation is the policy. ``data`` is the new path of its scenario set, if it has moved; ``metrics`` are
    extra columns of ``episodes.csv``, or a set of metrics, for ``results``, ``differences`` and ``by-TAG``.

    Raises:
        DataError: A run folder or the scenario set is missing, damaged, or not that of the evaluation.
        UsageError: A file exists, no evaluation was given, or none has one of the metrics.
    """
    texts = {}
    for table in _tables(read_evaluations(runs), data, metrics):
        kinds = {"csv": table.csv(), "md": table.markdown(), "tex": table.latex()}
        texts |= {f"{table.name}.{kind}": text for kind, text in kinds.items()}
    for name in texts:
        check_output(out / name, overwrite)
    for name, text in texts.items():
        write_text(out / name, text)
    return [out / name for name in texts]


def exported_metrics(runs: Sequence[EpisodeTable], extra: Sequence[str] = ()) -> list[str]:
    """Return the metrics of the files: the headline, progress in metres, user-defined ones, and ``extra``.

    Raises:
        UsageError: No run has such a column.
    """
    names = result_tables.sort_metrics(result_tables.metric_names(runs))
    requested = {"progress"}
    for entry in extra:
        if entry not in SETS and entry not in names:
            raise UsageError(f"no run has a mean of {entry!r}", cure=did_you_mean(entry, names))
        requested.update(SETS.get(entry, (entry,)))
    first = result_tables.headline_names(names)
    rest = [name for name in names if name in requested or name not in (*METRICS, *ADDED)]
    return [*first, *(name for name in rest if name not in first)] or names


def _tables(runs: Sequence[EpisodeTable], data: Path | None, extra: Sequence[str]) -> list[Table]:
    default_metrics, metrics = exported_metrics(runs), exported_metrics(runs, extra)
    results = [result_tables.results_table(runs, metrics)]
    if len(runs) > 1:
        others = [run for run in runs[:-1] if comparable(runs[-1], run)]
        results.append(result_tables.differences_table(runs[-1], others, metrics))
    if any("collision_type" in run.metrics for run in runs):
        results.append(result_tables.collisions_table(runs))
    added = [name for name in metrics if name not in default_metrics]
    results += strata_tables(runs, EvaluatedSet(runs[-1], data).tags(), added)
    return results + transfer_tables(runs)


def strata_tables(runs: Sequence[EpisodeTable], tags: Tags, extra: Sequence[str] = ()) -> list[Table]:
    """Return a table for each tag of the scenarios, over the runs on these scenarios, with ``extra`` metrics."""
    evaluated = [run for run in runs if any(key in tags for key in run.scenarios)]
    known = {name for values in tags.values() for name in values}
    names = dict.fromkeys((*KEY_METRICS, *extra))
    metrics = [name for name in names if any(name in run.metrics for run in evaluated)]
    return [
        result_tables.strata_table(evaluated, tags, tag, metrics)
        for tag in result_tables.STRATA
        if tag in known
    ]


def transfer_tables(runs: Sequence[EpisodeTable]) -> list[Table]:
    """Return a matrix of training and evaluation data for each metric; none where all runs share one set."""
    if len({result_tables.set_key(run.data) for run in runs}) < 2:
        return []
    known = [name for name in TRANSFER_METRICS if any(result_tables.summarise(run, name).n for run in runs)]
    return [result_tables.transfer_table(runs, name) for name in known]
