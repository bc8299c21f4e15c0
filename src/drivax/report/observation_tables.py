"""Tables of ``drivax inspect --observations``."""

from __future__ import annotations

import math

from rich.table import Table

from drivax.evaluation.observation_statistics import FeatureStatistics, ObservationStatistics


def observation_overview(found: ObservationStatistics) -> str:
    """What was looked at, in one line, and whether anything is broken."""
    looked = f"{found.states:,} states of {found.episodes:,} episodes driven by {found.planner}"
    crashed = f"{found.collisions:,} with a collision"
    broken = "every number is finite" if not found.broken else f"{found.broken:,} entries are NaN or infinite"
    return f"{looked}, {crashed}; {broken}"


def observation_table(found: ObservationStatistics) -> Table:
    """A row per column of each group, under a row for the group."""
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("feature", no_wrap=True)
    heads = ("n", "mean", "std", "min", "max", "NaN, Inf", "r collision")
    for name in heads + (("importance",) if found.permuted else ()):
        table.add_column(name, justify="right")
    group = None
    for one in found.features:
        if one.group != group:
            group = one.group
            whole = ("", cell(found.groups[group])) if found.permuted else ()
            table.add_row(group, *("",) * (len(heads) - 1), *whole, style="bold")
        table.add_row(f"  {one.name}", *_cells(one), *((cell(one.importance),) if found.permuted else ()))
    return table


def _cells(one: FeatureStatistics) -> list[str]:
    numbers = [cell(value) for value in (one.mean, one.std, one.low, one.high)]
    return [f"{one.count:,}", *numbers, f"{one.broken:,}" if one.broken else "", cell(one.collision)]


def cell(value: float) -> str:
    """A number with two digits behind the point; empty where there is none."""
    return "" if math.isnan(value) else f"{value:.2f}".replace("-0.00", "0.00")
