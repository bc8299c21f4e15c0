"""Trained policies as planners and as traffic: from a training run, an exported folder, or the zoo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax

from drivax.errors import UsageError
from drivax.files import replace_folder
from drivax.learning.config import TrainConfig, split_traffic
from drivax.planners.planner import Planner
from drivax.planners.planner_traffic import PlannerTraffic, with_driver
from drivax.reading import explain_damage
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.seal import seal
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints, pack, unpack
from drivax.tracking.run_folder import RunFolder, policy_folder, seed_folders, training_sets

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
