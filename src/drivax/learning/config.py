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
from drivax.learning.training_log import Rule
from drivax.plugins import is_dotted
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, NoisyStart
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import TRAFFIC, make_traffic
from drivax.simulator.types import Traffic
from drivax.tasks.actions import DirectState
from drivax.tasks.task import Task
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.zoo import is_policy, policy_folder, zoo

#: Built-in algorithms by ``kind``, or a configuration of your own.
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
    """Settings of ``drivax train``; every preset in ``configs/`` is one of these.

    Attributes:
        total_steps: Environment steps; rounded up to whole iterations.
        seed: Seed of networks, environments and exploration.
        task: Actions, observation, reward, termination, and the metrics that are logged during training.
        algorithm: Learning algorithm and its settings.
        traffic: How other agents move in training and validation: ``log``, ``idm``, ``package.module:name``, or a
            trained policy (its run folder or ``zoo:NAME``).
        start: How training episodes begin; validation begins as logged.
        earliest_start, latest_start: Training episodes begin at a random step of the log between the two; validation
            episodes at step 10.
        begin_from: Another run to fine-tune (``RUN``, its best checkpoint, or ``RUN@STEP``): its networks are taken
            over, the rest of the state is fresh. All other settings may differ as long as the networks fit.
        evaluate_every: Iterations between validations (with ``--validation``); 0: only at the end.
        checkpoint_every: Iterations between checkpoints; the last iteration always has one.
        keep: Number of newest checkpoints to keep in addition to the best.
        checkpoint_rule: How validation ranks checkpoints: ``score``; ``lexicographic``: fewest failures, then progress,
            then comfort; ``fitted_q``: the return that fitted-Q evaluation expects on held-out steps, for offline
            algorithms with ``fitted_q.updates``.
        patience: Validations without improvement after which training stops; 0: never.
        devices: Number of this machine's devices; None: all that seeds or environments can be divided among.
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
                cure="use patience 0 to train to the end",
            )
        if self.patience and not self.evaluate_every:
            raise UsageError("patience needs validations", cure="set evaluate_every")
        if self.checkpoint_rule == "fitted_q" and not _has_fitted_q(self.algorithm):
            raise UsageError(
                "checkpoint_rule fitted_q needs fitted-Q evaluation",
                cure="set algorithm.fitted_q.updates of cql, iql or td3_bc",
            )
        _check_traffic(self.traffic)
        self.environment(LogTraffic())  # checks the steps at which episodes begin

    def environment(self, traffic: Traffic) -> Driving:
        """Return the environment of training with :attr:`traffic`, as ``policies.find_traffic`` finds it."""
        return Driving(Simulator(self.task, traffic, self.start), self.latest_start, self.earliest_start)

    @property
    def iterations(self) -> int:
        """Number of iterations of the whole run."""
        return -(-self.total_steps // self.algorithm.steps_per_iteration)


def split_traffic(name: str) -> tuple[str | None, str]:
    """Return the trained policy (None without one) and the base traffic of a name like ``zoo:NAME+idm``.

    Raises:
        UsageError: There is no such traffic.
    """
    run, plus, base = name.rpartition("+")
    if plus and base in TRAFFIC and is_policy(run):
        return run, base
    if is_policy(name) and name not in TRAFFIC:
        return name, "log"
    if name not in TRAFFIC and not is_dotted(name):
        kinds = [*TRAFFIC, "package.module:name", "the folder of a training run", *zoo()]
        raise UsageError(f"there is no traffic {name!r}", cure=f"use {', '.join(kinds)}")
    return None, name


def _check_traffic(name: str) -> None:
    """Raise UsageError or DataError for a traffic that does not exist, before any work is done."""
    run, base = split_traffic(name)
    make_traffic(base)
    if run is not None:
        RunFolder.open(policy_folder(run))


def _has_fitted_q(algorithm: Algorithm) -> bool:
    return isinstance(algorithm, OfflineConfig) and algorithm.fitted_q.updates > 0
