"""Action rarity: inverse density of the expert's action among all expert actions of a set.

Actions are in units of the action space, [-1, 1] in both dimensions. A histogram of the actions of one set can be saved
and used to score others.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax import settings
from drivax.curation.kinematic import check_positive
from drivax.curation.logged import LoggedScenario
from drivax.errors import DataError, UsageError
from drivax.files import atomic_write, check_output
from drivax.planners.simple import expert_action
from drivax.reading import explain_damage, parse_json, read_arrays
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.tasks.actions import Physical

Actions = Float[np.ndarray[Any, Any], "n 2"]
Values = Float[np.ndarray[Any, Any], " n"]
QueryActions = Float[np.ndarray[Any, Any], "m 2"]
QueryValues = Float[np.ndarray[Any, Any], " m"]
Cells = Int[np.ndarray[Any, Any], " m"]

#: The default action space of imitation and offline learning.
_SPACE = Physical()
#: Maximum number of bins along each dimension, maximum standard deviation of a kernel, and maximum bytes of a file:
#: smoothing takes seconds with the largest ones.
_MOST_CELLS, _MOST_BANDWIDTH, _MOST_BYTES = 1024, 0.5, 16 << 20
#: Number of bins of the published histogram along each dimension, and constant that is added to its scores.
_PUBLISHED_BINS, _PUBLISHED_CONSTANT = 89, 0.01
_CURE = "write it with `drivax curate action_rarity --actions FILE`"


@dataclass(frozen=True, eq=False)
class ActionHistogram:
    """Counts of the expert's actions of a set.

    Attributes:
        counts: Number of actions in each bin of acceleration and of curvature.
        edges: Edges of the bins along both dimensions: in units of the action space (:class:`KernelRarity`), or in m/s2
            and 1/m.
        median: Median density of the actions (only of :class:`KernelRarity`; otherwise 0).
    """

    counts: Int[np.ndarray[Any, Any], "rows columns"]
    edges: tuple[Values, Values]
    median: float = 0.0


@dataclass(frozen=True)
class ExpertActions:
    """Score function that returns the logged action of every step, in the default action space."""

    def __call__(self, bank: ScenarioBank, log: LoggedScenario) -> dict[str, Array]:
        """Return the clipped ``action [T, 2]``, and ``known [T]``: ego is observed at the step and at the next two.

        The curvature depends on the logged position two steps later.
        """
        action = jax.vmap(lambda context: expert_action(bank, context, _SPACE))(log.context)
        padded_valid = jnp.concatenate([log.valid, jnp.zeros(2, bool)])
        known = log.valid & padded_valid[1:-1] & padded_valid[2:]
        return {"action": jnp.clip(action, -1.0, 1.0), "known": known}


@dataclass(frozen=True)
class KernelRarity:
    """Inverse density by Gaussian kernels, tempered and clipped.

    The density (Rosenblatt, 1956; Parzen, 1962) is computed on a grid. Counts per cell are convolved with the kernel
    and mirrored at the bounds, so that the density integrates to 1 over the action space; it is interpolated linearly
    between cell centres. The score at density p is ``min((p_median / p) ** temper, most) / most``, where ``p_median``
    is the median density over steps: actions of median density score 1 / most, more common ones less, very rare ones 1.

    Attributes:
        bandwidth: Standard deviation of the kernel, in units of the action space.
        cells: Cells of the grid along each dimension.
        temper: Exponent: 1 is inverse density, 0 gives all actions the same score.
        most: Tempered density ratio at which scores are clipped.
    """

    #: Name of the method with these settings.
    method: ClassVar[str] = "action_rarity"

    bandwidth: float = 0.05
    cells: int = 256
    temper: float = 0.5
    most: float = 20.0

    def __post_init__(self) -> None:
        if not 0.0 < self.bandwidth <= _MOST_BANDWIDTH:
            cure = f"use more than 0, and at most {_MOST_BANDWIDTH}"
            raise UsageError(f"bandwidth is {self.bandwidth}", cure=cure)
        if not 2 <= self.cells <= _MOST_CELLS:
            raise UsageError(f"cells is {self.cells}", cure=f"use 2 to {_MOST_CELLS:,}")
        if not 0.0 <= self.temper <= 1.0:
            raise UsageError(f"temper is {self.temper}", cure="use 0 to 1")
        if not 1.0 <= self.most < float("inf"):
            raise UsageError(f"most is {self.most}", cure="use 1 or more, but not inf")

    @property
    def edges(self) -> tuple[Values, Values]:
        """Edges of the bins of acceleration and of curvature, in units of the action space."""
        edges = np.linspace(-1.0, 1.0, self.cells + 1)
        return edges, edges

    def histogram(self, actions: Actions) -> ActionHistogram:
        """Return the histogram of actions, which are in [-1, 1]."""
        counts = np.histogram2d(actions[:, 0], actions[:, 1], self.edges)[0].astype(np.int64)
        histogram = ActionHistogram(counts, self.edges)
        return replace(histogram, median=float(np.median(self.density(histogram, actions))))

    def density(self, histogram: ActionHistogram, at: QueryActions) -> QueryValues:
        """Return the density of a set's actions at the points ``at``, per unit of area."""
        from scipy.ndimage import gaussian_filter, map_coordinates  # takes 0.1 s to import

        counts, cell = histogram.counts.astype(np.float64), 2.0 / self.cells
        kernel_sum = gaussian_filter(counts, self.bandwidth / cell, mode="reflect", truncate=6.0)
        position = (np.asarray(at, np.float64).T + 1.0) / cell - 0.5
        return map_coordinates(kernel_sum, position, order=1, mode="nearest") / (counts.sum() * cell * cell)

    def scores(self, histogram: ActionHistogram, at: QueryActions) -> QueryValues:
        """Return the scores of the actions ``at``, in [0, 1], from a set's histogram."""
        with np.errstate(divide="ignore", over="ignore"):  # a density of 0 gives infinity, which is clipped
            rarity = (histogram.median / self.density(histogram, at)) ** self.temper
        return np.minimum(rarity, self.most) / self.most


@dataclass(frozen=True)
class PublishedRarity:
    """Inverse frequency in the published histogram of acceleration (m/s2) and curvature (1/m).

    A cell with h actions has the weight ``1 / (h + 1)``, divided by the mean over all cells (including empty cells and
    those of zero width). The score is ``min(weight, most) / most + 0.01``, at most 1; in a large set the constant
    dominates it. The bins cover the action space. The published code counts an action on the edge of two bins in the
    upper bin but looks it up in the lower one, which affects standing still. Here both use the upper bin.

    Attributes:
        most: Weight at which scores are clipped; no cell reaches 3 while a third of them are empty.
    """

    #: Name of the method with these settings.
    method: ClassVar[str] = "action_rarity_published"

    most: float = 3.0

    def __post_init__(self) -> None:
        check_positive({"most": self.most})

    @property
    def edges(self) -> tuple[Values, Values]:
        """Edges of the 89 bins of acceleration and of curvature; shared ends of two ranges occur twice."""
        acceleration = [np.linspace(-10, -2, 20), np.linspace(-2, 1.5, 50), np.linspace(1.5, 8, 20)]
        curvature = [np.linspace(-1, -0.2, 25), np.linspace(-0.2, 0.2, 40), np.linspace(0.2, 1, 25)]
        return np.concatenate(acceleration), np.concatenate(curvature)

    def histogram(self, actions: Actions) -> ActionHistogram:
        """Return the histogram of actions, which are in [-1, 1]; its edges are in m/s2 and 1/m."""
        counts = np.zeros((_PUBLISHED_BINS, _PUBLISHED_BINS), np.int64)
        np.add.at(counts, self._cell(actions), 1)
        return ActionHistogram(counts, self.edges)

    def scores(self, histogram: ActionHistogram, at: QueryActions) -> QueryValues:
        """Return the scores of the actions ``at``, in [0, 1], from the counts of a set in their bins."""
        weight = 1.0 / (histogram.counts + 1.0)
        rarity = np.minimum((weight / weight.mean())[self._cell(at)], self.most) / self.most
        return np.minimum(rarity + _PUBLISHED_CONSTANT, 1.0)

    def _cell(self, actions: QueryActions) -> tuple[Cells, Cells]:
        scale = np.where(actions[:, 0] < 0, _SPACE.braking_mps2, _SPACE.acceleration_mps2)
        values = (actions[:, 0] * scale, actions[:, 1] * _SPACE.steering)
        pairs = zip(self.edges, values, strict=True)
        row, column = (np.searchsorted(edges, value, side="right") - 1 for edges, value in pairs)
        return row, column


def known_actions(
    actions: Float[np.ndarray[Any, Any], "N T 2"], known: Bool[np.ndarray[Any, Any], "N T"]
) -> Actions:
    """Return the known actions of a set.

    Raises:
        DataError: There is none.
    """
    if not known.any():
        raise DataError("no log has three consecutive steps, so no action is known", cure="check the set")
    return np.asarray(actions[known], np.float64)


def rarity_steps(
    config: KernelRarity | PublishedRarity,
    actions: Float[np.ndarray[Any, Any], "N T 2"],
    known: Bool[np.ndarray[Any, Any], "N T"],
    histogram: ActionHistogram | None = None,
) -> Float[np.ndarray[Any, Any], "N T"]:
    """Return the score of every step of a set, by the histogram of its own actions or by a given one.

    Steps at which the expert's action is unknown score 0.

    Raises:
        DataError: No action is known.
    """
    expert = known_actions(actions, known)
    steps = np.zeros(known.shape)
    steps[known] = config.scores(config.histogram(expert) if histogram is None else histogram, expert)
    return steps


def write_actions(
    config: KernelRarity | PublishedRarity, histogram: ActionHistogram, set_hash: str, out: Path
) -> None:
    """Write the histogram of a set's actions, the set's hash, and the settings that score by it, as ``.npz``.

    The arrays are ``settings`` (JSON), ``counts``, ``acceleration_edges``, ``curvature_edges`` and ``median``.

    Raises:
        UsageError: ``out`` exists.
    """
    check_output(out, False)
    names = ("acceleration_edges", "curvature_edges")
    arrays = dict(zip(names, histogram.edges, strict=True)) | {"counts": histogram.counts}
    text = json.dumps({"method": config.method, "set_hash": set_hash, **settings.plain(config)})
    with atomic_write(out) as file:
        np.savez_compressed(
            file, allow_pickle=False, settings=np.array(text), median=np.array(histogram.median), **arrays
        )


def read_actions(
    default: KernelRarity | PublishedRarity, file: Path
) -> tuple[KernelRarity | PublishedRarity, ActionHistogram, str]:
    """Read settings of the type of ``default``, a histogram, and the hash of its set, as :func:`write_actions` wrote.

    Raises:
        DataError: The file is missing or damaged, or of another method.
    """
    arrays = read_arrays(file, _CURE, _MOST_BYTES)
    with explain_damage(file, _CURE, "not a histogram of actions, or damaged"):
        values = parse_json(str(arrays["settings"][()]).encode())
        method, set_hash = str(values.pop("method")), str(values.pop("set_hash"))
        if method not in (KernelRarity.method, PublishedRarity.method):
            raise ValueError(f"unknown method {method}")
        counts, median = arrays["counts"], float(arrays["median"])
        edges = arrays["acceleration_edges"], arrays["curvature_edges"]
        if method == default.method:
            try:
                config = settings.load(type(default), values, trust=())
            except UsageError as error:
                raise ValueError(error.problem) from error
            same_bins = all(np.array_equal(*pair) for pair in zip(edges, config.edges, strict=True))
            shape = tuple(len(ends) - 1 for ends in config.edges)
            if not same_bins or counts.shape != shape or counts.dtype != np.int64:
                raise ValueError("bins and settings differ")
            is_valid = counts.min() >= 0 and counts.sum() > 0 and 0.0 <= median < float("inf")
            if not is_valid or (median == 0.0) == isinstance(default, KernelRarity):
                raise ValueError("a count or the median is invalid")
            return config, ActionHistogram(counts, edges, median), set_hash
    raise DataError(f"is a histogram of {method}", file=file, cure=f"use curate {method}, or another file")
