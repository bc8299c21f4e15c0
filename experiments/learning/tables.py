"""Write the results of ``presets.py`` and ``training.py`` as tables and learning curves to the pages of the docs.

The content goes between ``<!-- presets.py: WHAT -->`` and ``<!-- presets.py: end -->``; see :func:`format_block`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from drivax.report.charts import format_compact
from drivax.report.pictures.palette import LIGHT, SERIES
from experiments.repository import DOCS

FOLDER = DOCS / "algorithms"
COLUMNS = (
    "success", "accuracy", "accuracy_at_fault", "vmax_score", "collision", "offroad", "progress_ratio",
)  # fmt: skip
#: Metrics of the learning curves.
CURVES = ("success", "vmax_score")
#: Columns of the tables of trainings that differ in one setting.
COMPARED = ("success", "accuracy", "at_fault_collision", "offroad", "vmax_score")
#: Planners that plan along the given route and do not steer, marked in the tables: presets, and variants of ``ppo``.
ON_ROUTE = ("ppo", "self_play", "sac", "bc_sac", "bc_ppo")
VARIANTS = (
    "ppo_21m",
    "encoder_mlp",
    "encoder_lq",
    "encoder_entity",
    "weights",
    "constraints",
    "lq",
    "selfplay",
)
_BLOCK = re.compile(r"(<!-- presets\.py: (?!end)(?P<what>[^>]+?) -->\n).*?(<!-- presets\.py: end -->)", re.S)

Result = dict[str, Any]


def pages() -> Iterator[Path]:
    """Yield the pages that contain markers."""
    for page in (DOCS / "results" / "learning.md", *sorted(FOLDER.glob("*.md"))):
        if _BLOCK.search(page.read_text()):
            yield page


def fill_page(page: Path, learning: Result, training: Result) -> str:
    """Return the text of a page with the stored results between its markers."""

    def replace_block(match: re.Match[str]) -> str:
        kind, *names = match["what"].split()
        text = format_block(kind, names, learning, training, page)
        return f"{match[1]}\n{text}\n\n{match[3]}"

    return _BLOCK.sub(replace_block, page.read_text())


def format_block(kind: str, names: list[str], learning: Result, training: Result, page: Path) -> str:
    """Return a block: ``reached``, ``differences``, ``training``, ``comparison``, ``speed`` or ``curves``."""
    blocks: dict[str, Callable[[], list[str]]] = {
        "reached": lambda: results_table(learning),
        "differences": lambda: differences_table(learning),
        "training": lambda: times_table(learning),
        "comparison": lambda: comparison_table(learning["comparisons"][names[0]]),
        "speed": lambda: speeds_table(training),
        "curves": lambda: curve_images(learning, names, page),
    }
    return "\n".join(blocks[kind]())


def label(name: str) -> str:
    """Return the name of a planner in tables, with a mark if it plans along the route."""
    return f"`{name}` (route)" if name.removeprefix("zoo:") in (*ON_ROUTE, *VARIANTS) else f"`{name}`"


def label_pair(pair: str) -> str:
    """Return the text of a difference ``A - B`` with labels."""
    return " - ".join(label(name) for name in pair.split(" - "))


def results_table(learning: Result) -> list[str]:
    """Return a table with a row per planner, highest score first."""
    planners = learning["planners"]
    order = sorted(planners, key=lambda name: -planners[name]["vmax_score"]["mean"])
    rows = [[label(name), *(interval(planners[name][column]) for column in COLUMNS)] for name in order]
    return table(["planner", *(f"`{column}`" for column in COLUMNS)], rows)


def differences_table(learning: Result) -> list[str]:
    """Return a table with a row per pair of planners."""
    rows = [
        [label_pair(pair), *(interval(intervals[column], signed=True) for column in CURVES)]
        for pair, intervals in learning["differences"].items()
    ]
    return table(["difference", *(f"`{column}`" for column in CURVES)], rows)


def times_table(learning: Result) -> list[str]:
    """Return a table of the training time of each preset."""
    rows = [
        [label(name), str(training["seeds"]), f"{training['seconds']:,}"]
        for name, training in learning["training"].items()
    ]
    return table(["preset", "seeds", "each trained on one core for at most (s)"], rows)


def comparison_table(trainings: Mapping[str, Any]) -> list[str]:
    """Return a table with a row per training, then its differences from the first."""
    first = next(iter(trainings), None)
    rows = []
    for name, training in trainings.items():
        rows.append([
            label(name), str(training["seeds"]), f"{training['seconds']:,}",
            *(interval(training["results"][metric]) for metric in COMPARED),
        ])  # fmt: skip
    for name, training in trainings.items():
        if name != first:
            differences = training["differences"]
            cells = (interval(differences[metric], signed=True) for metric in COMPARED)
            rows.append([label_pair(f"{name} - {first}"), "", "", *cells])
    return table(["training", "seeds", "core time (s)", *(f"`{metric}`" for metric in COMPARED)], rows)


def speeds_table(training: Result) -> list[str]:
    """Return a table of training speeds and the shares of an iteration."""
    rows = []
    for name, result in training["training"].items():
        shares = [f"{share:.0%}" for share in result["share"].values()]
        rows.append([name, f"{result['steps_per_second']:,}", *shares])
    first = next(iter(training["training"].values()))
    return table(["training", "steps/s", *first["share"]], rows)


def curve_images(learning: Result, names: list[str], page: Path) -> list[str]:
    """Return the curves of presets (default: all), with their results on the test split."""
    curves = learning.get("curves", {})
    lines = []
    for name in names or curves:
        if name not in curves:
            lines += [f"No curves of preset `{name}` are stored yet.", ""]
            continue
        results, count = learning["planners"][name], learning["training"][name]["seeds"]
        cell = ", ".join(f"`{metric}` {interval(results[metric])}" for metric in CURVES)
        path = Path("../algorithms" if page.parent != FOLDER else "") / curve_file(name).name
        lines += [
            f"![Learning curves of {name}]({path.as_posix()})",
            "",
            f"Preset `{name}`, {count} {'seed' if count == 1 else 'seeds'}, on the validation split during training. "
            f"On the test split: {cell}.",
            "",
        ]
    return lines[:-1]


def curve_file(name: str) -> Path:
    """Return the file of a preset's learning curves."""
    return FOLDER / f"curve-{name}.png"


def draw_curves(name: str, curves: Mapping[str, Mapping[str, list[list[float]]]], seconds: float) -> Figure:
    """Draw learning curves of one preset against steps and minutes: a panel per quantity, a line per seed.

    Args:
        name: The preset.
        curves: Quantity -> seed -> points (step, value).
        seconds: Duration of the slowest seed, s.
    """
    last = max(points[-1][0] for lines in curves.values() for points in lines.values())
    minutes = seconds / 60.0 / last
    figure = Figure(figsize=(8.4, 3.3), dpi=100, facecolor="white", layout="constrained")
    figure.suptitle(name, fontsize=11, color=LIGHT["ink"])
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, (metric, lines) in zip(panels, curves.items(), strict=True):
        for number, (seed, points) in enumerate(sorted(lines.items())):
            steps, values = zip(*points, strict=True)
            axes.plot(
                steps, values, marker=".", linewidth=1.4, color=SERIES[number % len(SERIES)], label=seed
            )
        axes.set(xlabel="steps", ylabel=f"validation {metric}", xlim=(0, last))
        axes.secondary_xaxis("top", functions=(lambda x: x * minutes, lambda x: x / minutes)).set(
            xlabel="minutes on one core"
        )
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: format_compact(value)))
        axes.grid(color=LIGHT["crosswalk"])
        axes.spines[["top", "right"]].set_visible(False)
    panels[-1].legend(frameon=False, fontsize=8)
    return figure


def interval(result: Mapping[str, Any], signed: bool = False, digits: int = 3) -> str:
    """Format a mean with its interval."""
    numbers = [result[name] for name in ("mean", "low", "high")]
    if numbers[0] is None:
        # Without events only the lower bound of an exposure per event is known.
        return "-" if numbers[1] is None else f"above {numbers[1]:.{digits}f}"
    mean, *ends = (f"{number:{'+' if signed else ''}.{digits}f}" for number in numbers if number is not None)
    return f"{mean} [{', '.join(ends)}]" if ends else mean


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Format the lines of a Markdown table."""
    lines = [f"| {' | '.join(line)} |" for line in (heads, *rows)]
    return [lines[0], "|---" * len(heads) + "|", *lines[1:]]
