"""Action rarity: how seldom the expert of a set does what it does at a step.

The density of its actions is estimated from all steps of the set, in units of the action space ([-1, 1] in either
dimension); a step's score is the inverse of the density at its action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import gaussian_filter, map_coordinates

from drivax.curation.kinematic import check_positive
from drivax.curation.logged import Logged
from drivax.errors import DataError, UsageError
from drivax.planners.simple import expert_action
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.tasks.actions import Physical

Actions = Float[np.ndarray[Any, Any], "n 2"]
Values = Float[np.ndarray[Any, Any], " n"]
Others = Float[np.ndarray[Any, Any], "m 2"]
OtherValues = Float[np.ndarray[Any, Any], " m"]

#: What actions mean: that in which imitation and offline learning see them by default.
_SPACE = Physical()


@dataclass(frozen=True)
class ExpertActions:
    """The action that follows the log from every step, in units of the default action space."""

    def __call__(self, bank: ScenarioBank, log: Logged) -> dict[str, Array]:
        """``action [T, 2]`` within the bounds, and ``known [T]``: ego is there at the step and at the next two.

        The second of them tells the curvature; without it the action that follows the log is a guess.
        """
        action = jax.vmap(lambda context: expert_action(bank, context, _SPACE))(log.context)
        later = jnp.concatenate([log.valid, jnp.zeros(2, bool)])
        known = log.valid & later[1:-1] & later[2:]
        return {"action": jnp.clip(action, -1.0, 1.0), "known": known}


@dataclass(frozen=True)
class KernelRarity:
    """Inverse density by Gaussian kernels, tempered and clipped.

    The density (Rosenblatt, 1956; Parzen, 1962) is computed on a grid: counts per cell, convolved with the kernel and
    mirrored at the bounds, so that it integrates to 1 over the action space; between the cells' centres it is linear.
    The score of density p is ``min((p_median / p) ** temper, most) / most``, where ``p_median`` is that of the median
    step: usual actions score 1 / most, and from some rarity on all score 1.

    Attributes:
        bandwidth: Standard deviation of the kernel, in units of the action space.
        cells: Cells of the grid along either dimension.
        temper: Exponent: 1 is inverse frequency, 0 makes all alike.
        most: How many times rarer, after tempering, than the median step a step is at which clipping begins.
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
            raise UsageError(f"most is {self.most}", cure="use 1 or more")

    def density(self, actions: Actions, at: Others) -> OtherValues:
        """Density of actions, per unit of area of the action space, at others; both in [-1, 1]."""
        edges = np.linspace(-1.0, 1.0, self.cells + 1)
        counts = np.histogram2d(actions[:, 0], actions[:, 1], [edges, edges])[0]
        cell = 2.0 / self.cells
        smooth = gaussian_filter(counts, self.bandwidth / cell, mode="reflect", truncate=6.0)
        place = (np.asarray(at, np.float64).T + 1.0) / cell - 0.5
        return map_coordinates(smooth, place, order=1, mode="nearest") / (len(actions) * cell * cell)

    def scores(self, actions: Actions, at: Others) -> OtherValues:
        """Scores of actions ``at``, in [0, 1], by the density of ``actions``."""
        usual = np.median(self.density(actions, actions))
        with np.errstate(
            divide="ignore", over="ignore"
        ):  # where nobody ever was, rarity is infinite, and clipped
            rarity = (usual / self.density(actions, at)) ** self.temper
        return np.minimum(rarity, self.most) / self.most


@dataclass(frozen=True)
class PublishedRarity:
    """Inverse frequency in the study's histogram of acceleration (m/s2) and curvature (1/m).

    A cell with h of the actions weighs ``1 / (h + 1)``, over the mean of all cells, empty ones and those without width
    included; the score is ``min(weight, most) / most + 0.01``, cut at 1; the constant is most of it. Actions beyond
    the bins do not occur: the space is narrower. The study looks up an action on the edge of two bins in the lower one
    though it counts it in the upper one, so that standing still is looked up beside itself; here both are the upper.

    Attributes:
        most: Weight at which clipping begins. It never does: no cell weighs so much.
    """

    most: float = 3.0

    @property
    def edges(self) -> tuple[Values, Values]:
        """Edges of the 89 bins of acceleration and of curvature; where two parts meet an edge comes twice."""
        acceleration = [np.linspace(-10, -2, 20), np.linspace(-2, 1.5, 50), np.linspace(1.5, 8, 20)]
        curvature = [np.linspace(-1, -0.2, 25), np.linspace(-0.2, 0.2, 40), np.linspace(0.2, 1, 25)]
        return np.concatenate(acceleration), np.concatenate(curvature)

    def scores(self, actions: Actions, at: Others) -> OtherValues:
        """Scores of actions ``at``, in [0, 1], by how often ``actions`` are in their cells."""
        cells = 89 * 89
        weight = 1.0 / (np.bincount(self._cell(actions), minlength=cells) + 1.0)
        rarity = np.minimum((weight / weight.mean())[self._cell(at)], self.most) / self.most
        return np.minimum(rarity + 0.01, 1.0)

    def _cell(self, actions: Others) -> Int[np.ndarray[Any, Any], " m"]:
        scale = np.where(actions[:, 0] < 0, _SPACE.braking_mps2, _SPACE.acceleration_mps2)
        values = (actions[:, 0] * scale, actions[:, 1] * _SPACE.steering)
        row, column = (
            np.searchsorted(edges, value, side="right") - 1
            for edges, value in zip(self.edges, values, strict=True)
        )
        return row * 89 + column


def rarity_steps(
    config: KernelRarity | PublishedRarity,
    actions: Float[np.ndarray[Any, Any], "N T 2"],
    known: Bool[np.ndarray[Any, Any], "N T"],
) -> Float[np.ndarray[Any, Any], "N T"]:
    """Score of every step of a set; 0 where the expert's action is not known.

    Raises:
        DataError: No action is known.
    """
    if not known.any():
        raise DataError("no log has two steps on end, so that no action is known", cure="check the set")
    own = np.asarray(actions[known], np.float64)
    steps = np.zeros(known.shape)
    steps[known] = config.scores(own, own)
    return steps
