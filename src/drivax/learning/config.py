"""Configuration of a training run."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivax.errors import UsageError
from drivax.learning.algorithm import AlgorithmConfig
from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.offline import OfflineConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.algorithms.td3_bc import Td3BcConfig
from drivax.learning.algorithms.warm_start import BcPpoConfig, BcSacConfig
from drivax.learning.driving import Driving
from drivax.learning.validation import Rule
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, NoisyStart
from drivax.tasks.actions import DirectState
from drivax.tasks.task import Task

#: What ``algorithm`` can be: ``kind: ppo``, ``sac``, ``bc``, ``bc_ppo``, ``bc_sac``, offline ``cql``, ``iql`` and
#: ``td3_bc``, or one's own.
Algorithm = (
    PpoConfig
    | SacConfig
    | BcConfig
    | BcPpoConfig
    | BcSacConfig
    | CqlConfig
    | IqlConfig
    | Td3BcConfig
    | AlgorithmConfig
)


@dataclass(frozen=True)
class TrainConfig:
    """What ``drivax train`` needs to know; every preset in ``configs/`` is one of these.

    Attributes:
        total_steps: Environment steps; rounded up to whole iterations.
        seed: Of networks, environments and exploration.
        task: Actions, observation, reward, termination, and the metrics that are logged on the way.
        algorithm: What learns, and how.
        traffic: How the others move, while learning and in validation: ``log``, ``idm``, ``package.module:name``, or a
            trained policy (its run folder or ``zoo:NAME``).
        start: How episodes begin while learning; validation begins as logged.
        earliest_start, latest_start: Episodes of learning begin at a random step of the log between the two; those of
            validation at step 10.
        begin_from: Another run (``RUN``, its best checkpoint, or ``RUN@STEP``) whose networks this one begins with; the
            rest of the state is fresh, and every other setting free as long as the networks fit.
        evaluate_every: Iterations between validations (with ``--validation``); 0: only at the end.
        checkpoint_every: Iterations between checkpoints; there is always one at the end.
        keep: How many of the newest checkpoints stay, beside the best one.
        checkpoint_rule: What makes one checkpoint better than another in validation: the ``score``, or
            ``lexicographic``: fewest failures, then progress, then comfort; ``fitted_q``, for offline algorithms that
            have updates of it: what it expects of the policy on held-out steps.
        patience: Learning stops early after so many validations that were no better than the best; 0: never.
        devices: How many of this machine's devices to use; None: all of them, as far as agents or their environments
            divide.
    """

    total_steps: int = 2_000_000
    seed: int = 0
    task: Task = field(default_factory=lambda: Task(metrics="training"))
    algorithm: Algorithm = field(default_factory=PpoConfig)
    traffic: str = "log"
    start: LogStart | NoisyStart = field(default_factory=LogStart)
    earliest_start: int = CURRENT_STEP
    latest_start: int = CURRENT_STEP
    begin_from: str | None = None
    evaluate_every: int = 0
    checkpoint_every: int = 20
    keep: int = 2
    checkpoint_rule: Rule = "score"
    patience: int = 0
    devices: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.task.actions, DirectState):
            raise UsageError("policies cannot learn in direct_state", cure="choose a space in [-1, 1]")
        if self.evaluate_every < 0 or min(self.checkpoint_every, self.keep) < 1 or self.patience < 0:
            raise UsageError(
                "evaluate_every and patience are at least 0, checkpoint_every and keep at least 1",
                cure="use patience 0 to go on to the end",
            )
        if self.patience and not self.evaluate_every:
            raise UsageError("patience needs validations", cure="set evaluate_every")
        if self.checkpoint_rule == "fitted_q" and not _fits_q(self.algorithm):
            raise UsageError(
                "the algorithm evaluates by no fitted Q",
                cure="set algorithm.fitted_q.updates of cql, iql or td3_bc",
            )
        # Refuses a traffic or a step that does not exist before any work is done.
        self.environment()

    def environment(self) -> Driving:
        """What is learned in."""
        # Here, because a policy that drives the others was trained with such a configuration itself.
        from drivax.learning.policy_traffic import find_traffic

        simulator = Simulator(self.task, find_traffic(self.traffic), self.start)
        return Driving(simulator, self.latest_start, self.earliest_start)

    @property
    def iterations(self) -> int:
        """Iterations of the whole run."""
        return -(-self.total_steps // self.algorithm.steps_per_iteration)


def _fits_q(algorithm: Algorithm) -> bool:
    return isinstance(algorithm, OfflineConfig) and algorithm.fitted_q.updates > 0
