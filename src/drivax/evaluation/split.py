"""Split scenarios into two arms, one for each planner of a comparison, at random or stratified."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64

from drivax.errors import UsageError, did_you_mean
from drivax.stats.clusters import dense, stratum_of_clusters

#: Strata of fewer recordings than this are taken together.
LEAST = 10


@dataclass(frozen=True)
class Split:
    """Which scenario is in which arm; recordings are never cut apart.

    Attributes:
        first: Which scenarios are in the first arm.
        strata: Number of the stratum of each scenario; all 0 where the split is random.
    """

    first: Bool[np.ndarray, " n"]
    strata: Int64[np.ndarray, " n"]

    @property
    def strata_count(self) -> int:
        """Number of strata."""
        return int(self.strata.max()) + 1


def strata_of(entries: Sequence[Mapping[str, Any]], tags: Sequence[str]) -> list[str]:
    """The stratum of each scenario: the words of its tags.

    Args:
        entries: What the manifest says about each scenario.
        tags: Names of tags, as ``difficulty``.

    Raises:
        UsageError: No scenario has one of the tags.
    """
    known = {name: None for entry in entries for name in entry["tags"]}
    for tag in tags:
        if tag not in known:
            raise UsageError(f"no scenario has a tag {tag!r}", cure=did_you_mean(tag, list(known)))
    return [" ".join(str(entry["tags"].get(tag, "unknown")) for tag in tags) for entry in entries]


def assign(clusters: Sequence[str], strata: Sequence[str] | None, ratio: float, seed: int) -> Split:
    """Assigns whole clusters to two arms at random, in each stratum as many to the first as ``ratio`` says.

    A cluster belongs to the stratum that most of its scenarios are of (the first by name among equals). Strata of fewer
    than ten clusters are taken together. What is lost by rounding in one stratum is made up for in the next.

    Args:
        clusters: Cluster of each scenario.
        strata: Stratum of each scenario; None: a random split.
        ratio: Share of the clusters that the first arm gets.
        seed: Seed of the random numbers.

    Raises:
        UsageError: An arm gets nothing.
    """
    labels = dense(clusters, len(clusters), "cluster")
    count = int(labels.max()) + 1
    of = np.zeros(count, np.int64)
    if strata is not None:
        of = stratum_of_clusters(_most_frequent(labels, strata), labels, LEAST)
    rng, first, seen, assigned = np.random.default_rng(seed), np.zeros(count, bool), 0, 0
    for stratum in range(int(of.max()) + 1):
        inside = rng.permutation(np.flatnonzero(of == stratum))
        seen += inside.size
        count_here = round(ratio * seen) - assigned
        first[inside[:count_here]] = True
        assigned += count_here
    if not first.any() or first.all():
        raise UsageError(
            f"{count} recordings at a ratio of {ratio} leave an arm empty",
            cure="pair, or drive more scenarios",
        )
    return Split(first[labels], of[labels])


def _most_frequent(labels: Int64[np.ndarray, " n"], strata: Sequence[str]) -> list[str]:
    """For each scenario the stratum that its cluster belongs to."""
    votes: dict[int, Counter[str]] = {}
    for label, stratum in zip(labels, strata, strict=True):
        votes.setdefault(int(label), Counter())[stratum] += 1
    winner = {label: min(counts, key=lambda name: (-counts[name], name)) for label, counts in votes.items()}
    return [winner[int(label)] for label in labels]
