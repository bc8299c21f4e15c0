"""How alike the methods of a long-tail study rank scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

from drivax.curation.scores import ScoreTable
from drivax.curation.subset import top_rows
from drivax.stats.ranking import correlation_interval, rank_correlation

#: Two rankings below this correlation (and above its negative) are called unrelated, above the other one related.
UNRELATED, RELATED = 0.1, 0.3
#: Share of the scenarios that are compared as the most critical ones of two methods.
_TOP = 0.05


def rankings(tables: Mapping[str, ScoreTable], clusters: Sequence[str]) -> list[dict[str, Any]]:
    """How alike the rankings of scenarios are: rank correlation, and how many of the most critical are the same.

    They are unrelated or related only where all of the correlation's interval is.

    Args:
        tables: By method, of one set.
        clusters: Recording of every scenario, which are drawn anew for the interval.
    """
    found = []
    for one, other in combinations([name for name in tables if name not in ("uniform", "oracle")], 2):
        first, second = tables[one].scenarios, tables[other].scenarios
        count = max(round(_TOP * len(first)), 1)
        tops = [set(top_rows(tables[name], count)) for name in (one, other)]
        low, high = correlation_interval(first, second, clusters)
        verdict = "undecided"
        if max(-low, high) < UNRELATED:
            verdict = "supported"
        elif low > RELATED or high < -RELATED:
            verdict = "contradicted"
        found.append(
            {
                "one": one,
                "other": other,
                "rho": rank_correlation(first, second),
                "interval": [low, high],
                "overlap": len(tops[0] & tops[1]) / count,
                "orthogonal": verdict,
            }
        )
    return found
