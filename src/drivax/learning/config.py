"""Configuration of a training run."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivax.learning.ppo import PpoConfig
from drivax.tasks.task import Task


@dataclass(frozen=True)
class TrainConfig:
    """What ``drivax train`` needs to know; every preset in ``configs/`` is one of these.

    Attributes:
        total_steps: Environment steps; rounded up to whole iterations.
        seed: Of networks, environments and exploration.
        task: Actions, observation, reward, termination.
        algorithm: What learns, and how.
        evaluate_every: Iterations between validations (with ``--validation``); 0: only at the end.
        checkpoint_every: Iterations between checkpoints; there is always one at the end.
    """

    total_steps: int = 2_000_000
    seed: int = 0
    task: Task = field(default_factory=Task)
    algorithm: PpoConfig = field(default_factory=PpoConfig)
    evaluate_every: int = 0
    checkpoint_every: int = 20

    @property
    def iterations(self) -> int:
        """Iterations of the whole run."""
        return -(-self.total_steps // self.algorithm.steps_per_iteration)
