"""Trained policies as traffic: a run folder whose policy drives the vehicles around ego."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivax.learning.config import TrainConfig
from drivax.learning.policies import load_policy
from drivax.planners.driven import PlannerTraffic, with_driver
from drivax.scenario.bank import ScenarioBank
from drivax.simulator.traffic import LogTraffic
from drivax.simulator.types import Traffic
from drivax.tracking.runs import RunFolder


@dataclass(frozen=True)
class PolicyTraffic(PlannerTraffic):
    """The policy of a run drives the vehicles nearest to ego (``planners.driven``); :func:`policy_traffic` makes one.

    Attributes:
        run: The run folder.
        samples: Whether the policy acts by a sample instead of the mode.
    """

    run: str = ""
    samples: bool = False

    @property
    def name(self) -> str:
        """As printed in tables: ``driven_by_RUN``, and the traffic of the others where it is not the log."""
        base = "" if self.base.name == "log" else f"+{self.base.name}"
        return f"driven_by_{Path(self.run).name}{base}"

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """The bank with the policy, and with what ``base`` needs.

        Raises:
            DataError: The checkpoint is missing or damaged.
        """
        bank = super().prepare(bank)
        return with_driver(bank, load_policy(self.run, bank, samples=self.samples)[0])


def policy_traffic(
    run: str | Path, *, count: int = 4, base: Traffic | None = None, samples: bool = False
) -> PolicyTraffic:
    """Traffic in which the best policy of a training run drives up to ``count`` vehicles around ego.

    Args:
        run: Run folder of ``drivax train``.
        count: How many vehicles it drives, at most; the nearest.
        base: How the others move; they replay the log by default.
        samples: Whether it acts by a sample instead of the mode.

    Raises:
        DataError: If the folder is no training run.
    """
    folder = RunFolder.open(run)
    task = folder.config(TrainConfig).task
    return PolicyTraffic(task, count, base or LogTraffic(), run=str(folder.path), samples=samples)
