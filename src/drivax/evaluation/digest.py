"""Digest of standard episodes: equal on all machines whose simulations agree up to rounding.

Rule-based planners drive 64 scenarios of the built-in world. The digest covers booleans, counts, which of them are
defined, and the steps of first events exactly, and some continuous quantities as cells of a grid. On a fixed grid,
values near an edge would fall into different cells on different machines. The grid of each quantity is therefore
shifted by that multiple of an eighth of its cell that keeps the edges farthest from all 64 values
(docs/guide/reproducibility.md has the distances).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float, Int64

from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import evaluate
from drivax.metrics.catalogue import EVENTS, METRICS, names_of
from drivax.planners.catalogue import PLANNERS
from drivax.scenario.store import ScenarioSet
from drivax.simulator.traffic.reactive import make_traffic
from drivax.synthetic.generate import Generation, generate

#: Number and seed of the scenarios, and each planner with its traffic.
SCENARIOS, SEED = 64, 33
ROLLOUTS = (("constant_velocity", "log"), ("idm", "log"), ("idm", "idm"))
#: Cell sizes of the grids, m.
UNITS = {"distance": 2.0, "progress": 2.0, "goal_distance": 2.0, "ade": 1.0}
#: Metrics that are booleans, codes or counts.
EXACT = (*names_of(METRICS, "rate", "code"), "steps", "last_step", "ignored_overlaps")
#: Number of candidate offsets of a grid, evenly spaced over a cell.
_OFFSETS = 8
#: Value of an undefined boolean, code or count.
_UNDEFINED = -9.0


def standard_digests() -> Iterator[tuple[str, str]]:
    """Generate the standard scenarios, evaluate the planners, and yield (name, digest) of each rollout and of all.

    The first pair holds the hash of the set, which the last digest does not cover.
    """
    with TemporaryDirectory() as folder:
        options = Generation(workers=os.cpu_count() or 1)
        data = ScenarioSet.open(generate(Path(folder) / "set", SCENARIOS, SEED, options).path)
        yield "scenarios", data.hash[:16]
        digests = []
        for planner, traffic in ROLLOUTS:
            table = evaluate(PLANNERS[planner](), data, traffic=make_traffic(traffic))
            digests.append(episode_digest(table))
            yield f"{planner}, {traffic}", digests[-1]
    yield "digest", _sha256("".join(digests).encode())


def episode_digest(table: EpisodeTable) -> str:
    """Return the digest of a table in memory, 16 hexadecimal digits."""
    assert table.in_memory is not None, "only a table in memory has the steps of first events"
    exact = [np.nan_to_num(table.metrics[name], nan=_UNDEFINED) for name in EXACT]
    cells = [grid_cells(table.metrics[name], unit)[0] for name, unit in UNITS.items()]
    columns = [*exact, *(table.in_memory.events[name] for name in EVENTS), *cells]
    return _sha256(np.stack([column.astype("<i8") for column in columns]).tobytes())


def grid_cells(
    values: Float[np.ndarray, " n"], unit: float
) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, " offset"]]:
    """Return the cell of each value, and for each offset of the grid the smallest distance of a value from an edge.

    ``unit`` is the size of a cell. Cells are numbered by their lower edge in eighths of ``unit``; undefined values
    (NaN) have the smallest int64. Distances are shares of ``unit``.
    """
    defined = np.isfinite(values)
    offsets = np.arange(_OFFSETS) / _OFFSETS
    phase = (values[defined, None] / unit - offsets) % 1.0
    distances = np.minimum(phase, 1.0 - phase).min(axis=0, initial=0.5)
    best = int(distances.argmax())
    cells = np.full(values.shape, np.iinfo(np.int64).min)
    cells[defined] = np.floor(values[defined] / unit - offsets[best]).astype(np.int64) * _OFFSETS + best
    return cells, distances


def _sha256(data: bytes) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256."""
    return hashlib.sha256(data).hexdigest()[:16]
