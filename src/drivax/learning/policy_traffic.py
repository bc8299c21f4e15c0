"""Trained policies as traffic, and every kind of traffic by name: the simulator's, and a policy around ego."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivax.errors import UsageError
from drivax.learning.policies import load_policy, open_policy
from drivax.planners.planner_traffic import PlannerTraffic, with_driver
from drivax.plugins import is_dotted
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.traffic.catalogue import TRAFFIC, make_traffic
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import Traffic
from drivax.tracking.zoo import is_policy, zoo


@dataclass(frozen=True)
class PolicyTraffic(PlannerTraffic):
    """Traffic in which the policy of a run drives the vehicles nearest to ego; :func:`policy_traffic` makes one.

    Attributes:
        run: The folder of the policy.
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
        run: Run folder of ``drivax train``, folder of ``pack_policy``, or ``zoo:NAME``.
        count: How many vehicles it drives, at most; the nearest.
        base: How the others move; they replay the log by default.
        samples: Whether it acts by a sample instead of the mode.

    Raises:
        UsageError: If the folder holds several agents, or the zoo has no such policy.
        DataError: If the folder is no training run.
    """
    folder, config = open_policy(run)
    return PolicyTraffic(config.task, count, base or LogTraffic(), run=str(folder.path), samples=samples)


def find_traffic(name: str) -> Traffic:
    """The traffic of a name, as a command line or a configuration says it.

    Args:
        name: One of ``simulator.traffic.catalogue.TRAFFIC``; ``package.module:name``; or the folder of a trained
            policy or
            ``zoo:NAME``, which then drives the vehicles nearest to ego, while the others replay the log, or behave as
            in a kind of traffic that is named behind it, ``zoo:NAME+idm``.

    Raises:
        UsageError: There is none of that name.
        DataError: A folder is no training run.
    """
    run, plus, base = name.rpartition("+")
    if plus and base in TRAFFIC and is_policy(run):
        return policy_traffic(run, base=make_traffic(base))
    if is_policy(name) and name not in TRAFFIC:
        return policy_traffic(name)
    if name not in TRAFFIC and not is_dotted(name):
        kinds = [*TRAFFIC, "package.module:name", "the folder of a training run", *zoo()]
        raise UsageError(f"there is no traffic {name!r}", cure=f"use {', '.join(kinds)}")
    return make_traffic(name)
