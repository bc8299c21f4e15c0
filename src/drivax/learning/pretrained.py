"""Networks of another run to start from: fine-tuning loads them, the rest of the state is fresh."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from drivax.errors import DataError, UsageError
from drivax.learning.policies import POLICY_FILE, open_policy
from drivax.learning.program import Program
from drivax.tracking.checkpoints import Checkpoints, is_part
from drivax.tracking.run_folder import RunFolder, run_and_step, training_sets


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
