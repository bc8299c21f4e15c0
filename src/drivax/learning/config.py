"""Configuration of a training run."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivax.checks import check_at_least
from drivax.errors import UsageError, did_you_mean
from drivax.learning.algorithm import AlgorithmConfig
from drivax.learning.algorithms.awac import AwacConfig
from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.offline import OfflineConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.algorithms.td3_bc import Td3BcConfig
from drivax.learning.algorithms.warm_start import BcPpoConfig, BcSacConfig
from drivax.learning.curriculum import Stage
from drivax.learning.driving import Driving, Egos, check_learnable
from drivax.learning.self_play import SelfPlay, SelfPlayConfig
from drivax.learning.training_log import Rule
from drivax.plugins import is_dotted
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.select.selection import Selection
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, NoisyStart
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import TRAFFIC, make_traffic
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.run_folder import RunFolder, is_policy, policy_folder, zoo

#: Built-in algorithms by ``kind``, or a configuration of your own.
Algorithm = (
    PpoConfig | SacConfig | BcConfig | BcPpoConfig | BcSacConfig | CqlConfig | IqlConfig | Td3BcConfig
    | AwacConfig
    | AlgorithmConfig
)  # fmt: skip

#: Name of the traffic in which the policy in training drives several vehicles.
SELF = "self"
#: Largest number of kinds of traffic in a training run.
MOST_SHARES = 16
#: Largest deviation of the sum of shares from 1.
_ROUNDING = 1e-3


@dataclass(frozen=True)
class Residency:
    """Scenarios on the device at a time, and how they are exchanged (:mod:`drivax.learning.residency`).

    Attributes:
        scenarios: Number of resident scenarios, a multiple of ``block``.
        block: Scenarios that are exchanged together.
        every: Iterations between two exchanges.
    """

    scenarios: int
    block: int = 32
    every: int = 1

    def __post_init__(self) -> None:
        check_at_least(self, 1, "scenarios", "block", "every")
        if self.scenarios % self.block or self.scenarios <= self.block:
            problem = f"residency.scenarios is {self.scenarios}, residency.block {self.block}"
            raise UsageError(problem, cure=f"use a multiple of {self.block} above it")


@dataclass(frozen=True)
class TrainConfig:
    """Settings of ``drivax train``; every preset in ``configs/`` is one of these, except ``studies/``.

    Attributes:
        total_steps: Decisions in all environments (``task.hold`` steps each), or logged steps that offline algorithms
            draw; rounded up to whole iterations.
        seed: Seed of networks, environments and exploration.
        task: Actions, observation, reward, termination, and the metrics that are logged during training.
        algorithm: Learning algorithm and its settings.
        traffic: How other agents move; see :func:`~drivax.learning.policies.find_traffic`. ``self``: the policy in
            training drives them. A mixture maps traffic to its share of the environments; shares sum to 1.
        self_play: Settings of the traffic ``self``.
        start: How training episodes begin; those of self-play and of validation begin as logged, the latter at step 10.
        egos: Vehicle that the policy drives in training: the recorded ego, or any vehicle with a route and a goal
            (``moving``, of a set made with ``--egos``). In validation it is the recorded ego.
        earliest_start, latest_start: Training episodes begin at a random step of the log between the two (exceptions:
            :class:`~drivax.learning.driving.Driving`). The first episodes of a run may also begin later, so that they
            end at different times.
        filters: Conditions on scenarios (``type=turn_left``); those that do not meet all of them are left out.
        residency: Scenarios on the device at a time; None: all of them.
        curriculum: Stages of the run (:mod:`drivax.learning.curriculum`); none: a single one.
        begin_from: Another run to fine-tune (``RUN``, its best checkpoint, or ``RUN@STEP``): its networks are loaded,
            the rest of the state is fresh. All other settings may differ as long as the networks fit.
        evaluate_every: Iterations between validations; 0: only at the end.
        checkpoint_every: Iterations between checkpoints; validations and the last iteration always have one.
        keep: Number of newest checkpoints to keep in addition to the best.
        checkpoint_rule: How validation ranks checkpoints; see :data:`~drivax.learning.training_log.Rule`.
        patience: Validations without improvement after which training stops; 0: never.
        devices: Number of local devices; None: the largest number that divides seeds, environments or batch.
    """

    total_steps: int = 2_000_000
    seed: int = 0
    task: Task = field(default_factory=lambda: Task(metrics="training"))
    algorithm: Algorithm = field(default_factory=PpoConfig)
    traffic: str | dict[str, float] = "log"
    self_play: SelfPlayConfig = field(default_factory=SelfPlayConfig)
    start: LogStart | NoisyStart = field(default_factory=LogStart)
    egos: Egos = "recorded"
    earliest_start: int = CURRENT_STEP
    latest_start: int = CURRENT_STEP
    filters: tuple[str, ...] = ()
    residency: Residency | None = None
    curriculum: tuple[Stage, ...] = ()
    begin_from: str | None = None
    evaluate_every: int = 0
    checkpoint_every: int = 20
    keep: int = 2
    checkpoint_rule: Rule = "score"
    patience: int = 0
    devices: int | None = None

    def __post_init__(self) -> None:
        check_learnable(self.task.actions)
        check_at_least(self, 1, "total_steps", "checkpoint_every", "keep")
        check_at_least(self, 0, "evaluate_every", "patience")
        Selection.parse(self.filters)
        names = [stage.name for stage in self.curriculum]
        if duplicates := [name for name in names if names.count(name) > 1]:
            raise UsageError(f"duplicate stage {duplicates[0]!r}", cure="give each stage its own name")
        if self.curriculum and isinstance(self.algorithm, OfflineConfig | BcConfig):
            raise UsageError(
                "a curriculum needs an algorithm that drives", cure="use ppo, sac or a warm start"
            )
        if (
            self.curriculum
            and (before := sum(stage.steps for stage in self.curriculum[:-1])) >= self.total_steps
        ):
            problem = f"stage {names[-1]!r} begins after {before:,} of {self.total_steps:,} steps"
            raise UsageError(problem, cure="raise total_steps, or shorten the stages")
        if self.curriculum and self.residency is not None:
            raise UsageError("a curriculum needs all scenarios on the device", cure="leave out residency")
        if self.patience and not self.evaluate_every:
            raise UsageError("patience needs validations", cure="set evaluate_every")
        fitted_q = isinstance(self.algorithm, OfflineConfig) and self.algorithm.fitted_q.updates > 0
        if self.checkpoint_rule == "fitted_q" and not fitted_q:
            cure = "set algorithm.fitted_q.updates of cql, iql, awac or td3_bc"
            raise UsageError("checkpoint_rule fitted_q needs fitted-Q evaluation", cure=cure)
        shares = self.shares.values()
        if len(shares) > MOST_SHARES:
            raise UsageError(f"traffic has {len(shares)} shares", cure=f"use {MOST_SHARES} or less")
        if not (min(shares, default=0.0) > 0.0 and abs(sum(shares) - 1.0) <= _ROUNDING):
            texts = [f"{name} {share:g}" for name, share in self.shares.items()]
            problem = f"shares of traffic are {', '.join(texts) or 'missing'}"
            raise UsageError(problem, cure="use shares of at least 0 with a sum of 1")
        for name in self.shares:
            if name != SELF:
                run, base = split_traffic(name)
                make_traffic(base)
                if run is not None:
                    RunFolder.open(policy_folder(run))
        if self.self_play.past and not isinstance(self.algorithm, PpoConfig | BcPpoConfig):
            raise UsageError("self_play.past needs ppo or bc_ppo", cure="set self_play.past to 0")
        self.environment(LogTraffic())  # checks the steps at which episodes begin

    def environment(self, traffic: Traffic) -> Driving:
        """Return the training environment with a traffic model (``policies.find_traffic``)."""
        simulator = Simulator(self.task, traffic, self.start)
        return Driving(simulator, self.latest_start, self.earliest_start, self.egos)

    @property
    def shares(self) -> dict[str, float]:
        """Share of the environments of each kind of traffic; shares of 0 are left out."""
        if isinstance(self.traffic, str):
            return {self.traffic: 1.0}
        return {name: share for name, share in self.traffic.items() if share}

    @property
    def validation_traffic(self) -> str:
        """Traffic of validation: the log, or if training does not use it, the largest share other than ``self``."""
        others = {name: share for name, share in self.shares.items() if name != SELF}
        return "log" if "log" in others else max(others, key=lambda name: others[name], default="log")

    def self_play_environment(self) -> SelfPlay:
        """Return the environment of the traffic ``self``."""
        simulator = Simulator(self.task)
        return SelfPlay(simulator, self.latest_start, self.earliest_start, self.egos, self.self_play)

    @property
    def iterations(self) -> int:
        """Number of iterations of the whole run."""
        return -(-self.total_steps // self.algorithm.steps_per_iteration)


def split_traffic(name: str) -> tuple[str | None, str]:
    """Return the policy (or None) and the base traffic of a name like ``zoo:NAME+idm``.

    Raises:
        UsageError: Unknown traffic.
    """
    run, plus, base = name.rpartition("+")
    if plus and base in TRAFFIC and is_policy(run, TRAFFIC):
        return run, base
    if is_policy(name, TRAFFIC):
        return name, "log"
    if name not in TRAFFIC and not is_dotted(name):
        kinds = [*TRAFFIC, "package.module:name", "the folder of a training run", *zoo()]
        cure = did_you_mean(name, [*TRAFFIC, *zoo()], otherwise=f"use {', '.join(kinds)}")
        raise UsageError(f"unknown traffic {name!r}", cure=cure)
    return None, name
