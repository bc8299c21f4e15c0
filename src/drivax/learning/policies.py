"""Trained policies as planners, as traffic and as a start: from a training run, an exported folder, or the zoo.

Fine-tuning loads the networks of another run; the rest of the state is fresh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax

from drivax.errors import DataError, UsageError
from drivax.files import replace_folder
from drivax.learning.config import TrainConfig, split_traffic
from drivax.learning.program import Program
from drivax.planners.planner import Planner
from drivax.planners.planner_traffic import PlannerTraffic, with_driver
from drivax.reading import explain_damage
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.seal import seal
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints, is_part, pack, unpack
from drivax.tracking.run_folder import RunFolder, policy_folder, run_and_step, seed_folders, training_sets

#: File with the parameters of an exported policy, which has no checkpoints.
POLICY_FILE = "policy.npz"
#: Entries of ``run.json`` that an exported policy keeps from its training; only the command may contain paths.
_PROVENANCE = ("command", "started", "versions", "git", "validation", "step", "critics")
#: Suffix of the name of a policy whose critics are not healthy (:mod:`drivax.learning.algorithms.offline`).
_UNHEALTHY = " (unhealthy critics)"
#: Overrides: parameters do not depend on traffic and starts, and the traffic of the training run may no longer exist.
_AS_LOGGED = ("--traffic", "log", "--start.kind", "log_start")


def open_policy(run: str | Path) -> RunFolder:
    """Open the folder of a trained policy.

    ``run`` is a run folder of ``drivax train``, a folder of :func:`export_policy`, or ``zoo:NAME``.

    Raises:
        UsageError: The folder contains several seeds, or the zoo has no such policy.
        DataError: It is not a run folder, or it should contain several seeds but has none.
    """
    folder = RunFolder.open(policy_folder(run))
    if folder.info.get("kind") == "seeds":
        seeds = seed_folders(folder.path)
        raise UsageError(f"contains {len(seeds)} seeds", file=folder.path, cure=f"name one, as {seeds[0]}")
    return folder


def load_policy(
    run: str | Path, bank: ScenarioBank, *, step: int | None = None, samples: bool = False,
    trust: Sequence[str] = (),
) -> tuple[Planner, Task]:  # fmt: skip
    """Load a trained policy as a planner, and the task that it was trained for.

    Args:
        run: As for :func:`open_policy`, with its errors; DataError if the parameters are missing or damaged.
        bank: Any bank; only shapes of its observations are read.
        step: Step of the checkpoint, shown in the planner's name; None: the best one, or the newest without validation.
            UsageError for a step of an exported policy.
        samples: Whether to sample actions instead of taking the mode.
        trust: Modules outside drivax whose code the policy may name (own features, rewards, ...); UsageError for
            others.
    """
    folder = open_policy(run)
    config = folder.config(TrainConfig, _AS_LOGGED, trust)
    file = folder.path / "config.yaml"
    try:
        with explain_damage(file, "fix the settings", "makes no policy"):
            learner = config.algorithm.build(config.environment(LogTraffic()), bank, config.iterations)
            template = jax.eval_shape(lambda key: learner.init(bank, key).parameters, jax.random.key(0))
    except UsageError as error:
        raise UsageError(error.problem, file=error.file or file, cure=error.cure) from error

    def planner(parameters: Any) -> Planner:
        run_name = _name(folder.path)
        name = run_name if step is None else f"{run_name}@{step}"
        return learner.planner(parameters, name + _UNHEALTHY * bool(folder.info.get("critics")), samples)

    policy_file = folder.path / POLICY_FILE
    if policy_file.is_file():
        if step is not None:
            problem = "is an exported policy without steps"
            raise UsageError(problem, file=folder.path, cure=f"leave out @{step}")
        return unpack(policy_file, jax.eval_shape(planner, template)), config.task
    checkpoints = Checkpoints(folder.checkpoints)
    checkpoint = checkpoints.best_or_newest() if step is None else step
    return planner(checkpoints.restore(template, checkpoint, part=".parameters")), config.task


def _name(run: str | Path) -> str:
    """Return the name of a run's folder, also for ``.`` and ``..``."""
    path = Path(run)
    return path.name if path.name not in ("", "..") else path.resolve().name


def export_policy(
    run: str | Path, out: str | Path, bank: ScenarioBank, notes: Mapping[str, Any] | None = None, *,
    overwrite: bool = False, trust: Sequence[str] = (),
) -> RunFolder:  # fmt: skip
    """Write the best policy of a run (the newest without validation) to a folder that loads like the run.

    The folder holds the planner's parameters, the configuration, and the provenance: command as typed, versions,
    commit and hashes of data sets. Only the command, and a run named as ``traffic``, may contain local paths.

    Args:
        run: As for :func:`load_policy`, with its errors; the traffic of its training must still exist.
        out: Folder to write; its name is that of the policy.
        bank: Any bank; only shapes of its observations are read.
        notes: More entries for ``run.json``, plain JSON values.
        overwrite: Replace ``out`` if it is a run folder, but not that of a training run.
        trust: As for :func:`load_policy`.
    """
    folder = open_policy(run)
    step = Checkpoints(folder.checkpoints).best_or_newest()
    planner, _ = load_policy(run, bank, step=step, trust=trust)
    entries = {name: folder.info.get(name) for name in _PROVENANCE}
    data = [{name: entry.get(name) for name in ("hash", "scenarios")} for entry in training_sets(folder.info)]
    entries |= {"kind": "policy", "data": data, "machine": None, **(notes or {})}
    if step is not None:
        entries["step"] = step
    config = replace(folder.config(TrainConfig, trust=trust), begin_from=None)
    RunFolder.check(Path(out), overwrite, "policy")
    with replace_folder(Path(out)) as partial_folder:
        exported = RunFolder.create(partial_folder, config, overwrite=True).note(**entries)
        pack(partial_folder / POLICY_FILE, planner)
        seal(partial_folder, POLICY_FILE)
    return RunFolder(Path(out), exported.info)


@dataclass(frozen=True)
class PolicyTraffic(PlannerTraffic):
    """Traffic in which the policy of a folder drives the vehicles nearest to ego, made by :func:`policy_traffic`."""

    run: str = field(kw_only=True)
    samples: bool = False
    trust: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name in tables: ``driven_by_RUN``, with the traffic of the other agents unless it is the log.

        For one of several seeds, ``RUN`` is ``RUN/seed-N``.
        """
        base = "" if self.base.name == "log" else f"+{self.base.name}"
        name = _name(self.run)
        run = f"{Path(self.run).resolve().parent.name}/" if name.startswith("seed-") else ""
        return f"driven_by_{run}{name}{base}"

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """Return the bank with the policy and the data of ``base``."""
        bank = super().prepare(bank)
        return with_driver(bank, load_policy(self.run, bank, samples=self.samples, trust=self.trust)[0])


def policy_traffic(
    run: str | Path, *, count: int = 4, base: Traffic | None = None, samples: bool = False,
    trust: Sequence[str] = (),
) -> PolicyTraffic:  # fmt: skip
    """Return traffic in which the best policy of a training run drives up to ``count`` vehicles nearest to ego.

    Args:
        run: As for :func:`open_policy`, with its errors.
        count: Largest number of vehicles that it drives.
        base: Traffic of all other agents; the log by default.
        samples: Whether to sample actions instead of taking the mode.
        trust: As for :func:`load_policy`.
    """
    folder, trust = open_policy(run), tuple(trust)
    task, base = folder.config(TrainConfig, _AS_LOGGED, trust).task, base or LogTraffic()
    # An absolute path cannot be mistaken for a name in the zoo.
    path = str(folder.path.absolute())
    return PolicyTraffic(task, count, base, run=path, samples=samples, trust=trust)


def find_traffic(name: str, trust: Sequence[str] = ()) -> Traffic:
    """Return the traffic with a name from the command line or a configuration.

    The name is one of ``simulator.traffic.reactive.TRAFFIC``; ``package.module:name``; or a trained policy (a folder or
    ``zoo:NAME``), which drives the vehicles nearest to ego. All other agents then follow the log, or the traffic named
    after a plus sign (``zoo:NAME+idm``). ``trust`` is that of :func:`load_policy`.

    Raises:
        UsageError: There is no such traffic, or the run in the folder is not a training run.
        DataError: It is not a run folder.
    """
    run, base = split_traffic(name)
    return make_traffic(base) if run is None else policy_traffic(run, base=make_traffic(base), trust=trust)


@dataclass(frozen=True)
class PretrainedRun:
    """A checkpoint of another run, and the data sets that it was trained on, as in its ``run.json``."""

    run: Path
    step: int
    data: list[dict[str, Any]]

    @classmethod
    def of(cls, name: str) -> PretrainedRun:
        """Find the checkpoint ``RUN@STEP``; for ``RUN`` the best one, or the newest without validation.

        Raises:
            UsageError: The folder contains several seeds or an exported policy.
            DataError: It is not a training run, or has no checkpoint.
        """
        run, step = run_and_step(name)
        folder = open_policy(run)
        if (folder.path / POLICY_FILE).is_file():
            problem = "is an exported policy, which cannot be fine-tuned"
            raise UsageError(problem, file=run, cure="name the training run")
        if step is None:
            step = Checkpoints(folder.checkpoints).best_or_newest()
        if step is None:
            raise DataError("has no checkpoint", file=run, cure="name a run that wrote one")
        return cls(Path(run), step, training_sets(folder.info))

    def __str__(self) -> str:
        return f"{self.run}@{self.step}"

    def notes(self) -> dict[str, Any]:
        """Return the entry of ``run.json``."""
        return {"run": str(self.run), "step": self.step, "data": self.data}

    def networks(self, state: Any) -> dict[str, Any]:
        """Return the stored networks by their paths in the initial state of one seed (or its shapes).

        Networks that the checkpoint lacks are omitted, except ``parameters``. Raises DataError for the first array that
        is missing or does not fit.
        """
        checkpoints = Checkpoints(RunFolder.open(self.run).checkpoints)
        leaves = [leaf["name"] for leaf in checkpoints.about(self.step)["leaves"]]
        networks = _networks(state)
        sources = {path: source for path in networks if (source := _source(path, leaves))}
        templates = {source: networks[path] for path, source in sources.items()}
        cure = "start from a run with the same network, observation and actions"
        restored = checkpoints.restore_parts(templates, self.step, cure)
        return {path: restored[source] for path, source in sources.items()}


def pretrained_networks(name: str | None, program: Program, log: Callable[[str], None]) -> dict[str, Any]:
    """Return the networks of the run ``RUN`` or ``RUN@STEP`` by their paths in the state, and log them."""
    if name is None:
        return {}
    run = PretrainedRun.of(name)
    networks = run.networks(program.seeds.member_shapes(program.shapes))
    log(f"starts from {', '.join(path.removeprefix('.') for path in networks)} of {run}")
    return networks


def initial_state(program: Program, networks: Mapping[str, Any]) -> Any:
    """Return the initial state of all seeds, with these networks in place of their own."""
    state, seeds = program.initial_state(), program.seeds
    if not networks:
        return state
    states = [replace_networks(seeds.member(state, number), networks) for number in range(len(seeds.seeds))]
    return program.state_of(states)


def replace_networks(state: Any, networks: Mapping[str, Any], at: str = "") -> Any:
    """Replace networks of a state, given by their paths."""
    fields = {
        name: replace_networks(value, networks, path) if _is_state(value) else networks.get(path, value)
        for name, path, value in _fields(state, at)
    }
    return replace(state, **fields)


def _networks(state: Any, at: str = "") -> dict[str, Any]:
    """Return the networks of a state by their paths."""
    networks: dict[str, Any] = {}
    for _, path, value in _fields(state, at):
        if _is_state(value):
            networks |= _networks(value, path)
        elif jax.tree.leaves(value):
            networks[path] = value
    return networks


def _fields(state: Any, at: str) -> Iterable[tuple[str, str, Any]]:
    """Yield name, path and value of the fields of a state that hold networks."""
    for name in getattr(type(state), "networks", ("parameters",)):
        yield name, f"{at}.{name}", getattr(state, name)


def _is_state(value: Any) -> bool:
    return hasattr(type(value), "networks")


def _source(path: str, stored: Iterable[str]) -> str | None:
    """Return the path of a network in a checkpoint: in the state or in a warm start's learner; None if missing."""
    name = path[path.rindex(".") :]
    for source in (name, f".learner{name}"):
        if any(is_part(leaf, [source]) for leaf in stored):
            return source
    return name if name == ".parameters" else None  # restoring reports missing parameters
