"""Action rarity: inverse density of the expert's action among all expert actions of a set.

Actions are in units of the action space, [-1, 1] in both dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.curation.kinematic import check_positive
from drivax.curation.logged import LoggedScenario
from drivax.errors import DataError, UsageError
from drivax.planners.simple import expert_action
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.tasks.actions import Physical

Actions = Float[np.ndarray[Any, Any], "n 2"]
Values = Float[np.ndarray[Any, Any], " n"]
QueryActions = Float[np.ndarray[Any, Any], "m 2"]
QueryValues = Float[np.ndarray[Any, Any], " m"]

#: The default action space of imitation and offline learning.
_SPACE = Physical()


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

    bandwidth: float = 0.05
    cells: int = 256
    temper: float = 0.5
    most: float = 20.0

    def __post_init__(self) -> None:
        check_positive({"bandwidth": self.bandwidth})
        if self.cells < 2:
            raise UsageError(f"cells is {self.cells}", cure="use 2 or more")
        if not 0.0 <= self.temper <= 1.0:
            raise UsageError(f"temper is {self.temper}", cure="use 0 to 1")
        if not 1.0 <= self.most < float("inf"):
            raise UsageError(f"most is {self.most}", cure="use 1 or more, but not inf")

    def density(self, actions: Actions, at: QueryActions) -> QueryValues:
        """Return the density of ``actions`` at the points ``at``, per unit of area; both are in [-1, 1]."""
        from scipy.ndimage import gaussian_filter, map_coordinates  # takes 0.1 s to import

        edges = np.linspace(-1.0, 1.0, self.cells + 1)
        counts = np.histogram2d(actions[:, 0], actions[:, 1], [edges, edges])[0]
        cell = 2.0 / self.cells
        kernel_sum = gaussian_filter(counts, self.bandwidth / cell, mode="reflect", truncate=6.0)
        position = (np.asarray(at, np.float64).T + 1.0) / cell - 0.5
        return map_coordinates(kernel_sum, position, order=1, mode="nearest") / (len(actions) * cell * cell)

    def scores(self, actions: Actions, at: QueryActions) -> QueryValues:
        """Return the scores of the actions ``at``, in [0, 1], from the density of ``actions``."""
        median_density = np.median(self.density(actions, actions))
        with np.errstate(divide="ignore", over="ignore"):  # a density of 0 gives infinity, which is clipped
            rarity = (median_density / self.density(actions, at)) ** self.temper
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

    most: float = 3.0

    def __post_init__(self) -> None:
        check_positive({"most": self.most})

    @property
    def edges(self) -> tuple[Values, Values]:
        """Edges of the 89 bins of acceleration and of curvature; shared ends of two ranges occur twice."""
        acceleration = [np.linspace(-10, -2, 20), np.linspace(-2, 1.5, 50), np.linspace(1.5, 8, 20)]
        curvature = [np.linspace(-1, -0.2, 25), np.linspace(-0.2, 0.2, 40), np.linspace(0.2, 1, 25)]
        return np.concatenate(acceleration), np.concatenate(curvature)

    def scores(self, actions: Actions, at: QueryActions) -> QueryValues:
        """Return the scores of the actions ``at``, in [0, 1], from the counts of ``actions`` in their cells."""
        cells = 89 * 89
        weight = 1.0 / (np.bincount(self._cell(actions), minlength=cells) + 1.0)
        rarity = np.minimum((weight / weight.mean())[self._cell(at)], self.most) / self.most
        return np.minimum(rarity + 0.01, 1.0)

    def _cell(self, actions: QueryActions) -> Int[np.ndarray[Any, Any], " m"]:
        scale = np.where(actions[:, 0] < 0, _SPACE.braking_mps2, _SPACE.acceleration_mps2)
        values = (actions[:, 0] * scale, actions[:, 1] * _SPACE.steering)
        pairs = zip(self.edges, values, strict=True)
        row, column = (np.searchsorted(edges, value, side="right") - 1 for edges, value in pairs)
        return row * 89 + column


def rarity_steps(
    config: KernelRarity | PublishedRarity,
    actions: Float[np.ndarray[Any, Any], "N T 2"],
    known: Bool[np.ndarray[Any, Any], "N T"],
) -> Float[np.ndarray[Any, Any], "N T"]:
    """Return the score of every step of a set; 0 where the expert's action is unknown.

    Raises:
        DataError: No action is known.
    """
    if not known.any():
        raise DataError("no log has three consecutive steps, so no action is known", cure="check the set")
    known_actions = np.asarray(actions[known], np.float64)
    steps = np.zeros(known.shape)
    steps[known] = config.scores(known_actions, known_actions)
    return steps
