"""Scores of a whole set, batch after batch, in one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from drivax.curation.logged import of_logs
from drivax.scenario.bank.scenario_bank import ScenarioBank, Sizes
from drivax.scenario.store import ScenarioSet

#: Scenarios that are scored side by side.
BATCH = 64
#: Called with (scenarios done, scenarios).
Progress = Callable[[int, int], None]
Array = np.ndarray[Any, Any]


def score_steps(data: ScenarioSet, of: Any, progress: Progress | None = None) -> dict[str, Array]:
    """What a function says of every step of every log of a set.

    Args:
        data: The scenarios.
        of: A hashable ``(bank, log) -> {name: [T, ...]}`` (:func:`drivax.curation.logged.of_logs`).
        progress: Called after every batch.

    Returns:
        By name ``[N, T, ...]``.

    Raises:
        DataError: A scenario has no future.
    """
    return each_batch(data, lambda bank: of_logs(of, bank), progress)


def each_batch(
    data: ScenarioSet, of: Callable[[ScenarioBank], dict[str, Any]], progress: Progress | None = None
) -> dict[str, Array]:
    """What a function says of banks of some scenarios of a set each, all of one shape: by name ``[N, ...]``."""
    sizes = Sizes.used(data)
    parts: list[dict[str, Any]] = []
    for first in range(0, len(data), BATCH):
        scenarios = data[first : first + BATCH]
        count = len(scenarios)
        if len(data) > BATCH:
            scenarios += [scenarios[-1]] * (BATCH - count)
        found = of(ScenarioBank.from_scenarios(scenarios, trim=sizes))
        # A batch is scored while the next one is stacked; no more than one waits.
        jax.block_until_ready(parts[-1:])
        parts.append({name: part[:count] for name, part in found.items()})
        if progress is not None:
            progress(first + count, len(data))
    return {name: np.concatenate([np.asarray(part[name]) for part in parts]) for name in parts[0]}


def valid_steps(data: ScenarioSet) -> Bool[Array, "N T"]:
    """At which steps ego is there."""
    return np.stack([np.asarray(scenario.record["agent_valid"][:, 0], bool) for scenario in data])
