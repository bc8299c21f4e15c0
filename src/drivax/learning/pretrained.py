"""The first state of a run: fresh, or fine-tuning the networks of another run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from drivax.errors import DataError, UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.policies import POLICY_FILE, open_policy
from drivax.learning.program import Program
from drivax.tracking.checkpoints import Checkpoints, is_part
from drivax.tracking.run_folder import run_and_step, trained_on

_PARAMETERS = ".parameters"


@dataclass(frozen=True)
class Pretrained:
    """A checkpoint of another run.

    Attributes:
        run: Run folder.
        step: Step of the checkpoint.
        data: Data sets that it was trained on, as in its ``run.json``.
    """

    run: Path
    step: int
    data: list[dict[str, Any]]

    @classmethod
    def of(cls, name: str) -> Pretrained:
        """Find the checkpoint ``RUN@STEP``, or of ``RUN`` the best, or the newest without a validation.

        Raises:
            UsageError: The folder holds several seeds, or an exported policy.
            DataError: It is no training run, or has no checkpoint.
        """
        run, step = run_and_step(name)
        folder, _ = open_policy(run)
        if (folder.path / POLICY_FILE).is_file():
            raise UsageError(
                "is an exported policy, which cannot be fine-tuned", file=run, cure="name the training run"
            )
        checkpoints = Checkpoints(folder.checkpoints)
        if step is None:
            step = checkpoints.best()
        if step is None:
            step = max(checkpoints.steps(), default=None)
        if step is None:
            raise DataError("has no checkpoint", file=run, cure="name a run that wrote one")
        return cls(Path(run), step, trained_on(folder.info))

    def __str__(self) -> str:
        return f"{self.run}@{self.step}"

    def notes(self) -> dict[str, Any]:
        """Return the entry of ``run.json``."""
        return {"run": str(self.run), "step": self.step, "data": self.data}

    def networks(self, state: Any) -> dict[str, Any]:
        """Return the stored networks by the paths that they replace in a fresh state of one seed, or its shapes.

        Networks that the checkpoint lacks are left out: a critic, where the other run only imitated.

        Raises:
            DataError: The first array that does not fit.
        """
        checkpoints = Checkpoints(self.run / "checkpoints")
        stored = [leaf["name"] for leaf in checkpoints.about(self.step)["leaves"]]
        networks = _networks(state)
        sources = {path: source for path in networks if (source := _source(path, stored))}
        templates = {source: networks[path] for path, source in sources.items()}
        cure = "begin from a run with the same network, observation and actions"
        restored = checkpoints.restore_parts(templates, self.step, cure)
        return {path: restored[source] for path, source in sources.items()}


def with_step(config: TrainConfig) -> TrainConfig:
    """Return the configuration with the step of its pretrained run, so that resuming finds the same checkpoint.

    Raises:
        UsageError, DataError: As :meth:`Pretrained.of`.
    """
    if config.begin_from is None:
        return config
    return replace(config, begin_from=str(Pretrained.of(config.begin_from)))


def pretrained_networks(name: str | None, program: Program, log: Callable[[str], None]) -> dict[str, Any]:
    """Return the networks of the run ``RUN`` or ``RUN@STEP`` by their paths in the state, and log them; none for None.

    Raises:
        UsageError, DataError: As :meth:`Pretrained.of` and :meth:`Pretrained.networks`.
    """
    if name is None:
        return {}
    run = Pretrained.of(name)
    networks = run.networks(program.seeds.member_shapes(program.shapes))
    log(f"begins with {', '.join(path.removeprefix('.') for path in networks)} of {run}")
    return networks


def first_state(program: Program, networks: Mapping[str, Any]) -> Any:
    """Return the first state of all seeds, each with these networks in place of its own."""
    fresh, seeds = program.first_state(), program.seeds
    if not networks:
        return fresh
    states = [with_networks(seeds.member(fresh, number), networks) for number in range(len(seeds.seeds))]
    return program.state_of(states)


def with_networks(state: Any, networks: Mapping[str, Any], at: str = "") -> Any:
    """Return a state with these networks, by their paths, in place of its own."""
    fields = {
        name: with_networks(value, networks, path) if _is_state(value) else networks.get(path, value)
        for name, path, value in _fields(state, at)
    }
    return replace(state, **fields)


def _networks(state: Any, at: str = "") -> dict[str, Any]:
    """Networks of a state by their paths."""
    networks: dict[str, Any] = {}
    for _, path, value in _fields(state, at):
        if _is_state(value):
            networks |= _networks(value, path)
        elif jax.tree.leaves(value):
            networks[path] = value
    return networks


def _fields(state: Any, at: str) -> Iterable[tuple[str, str, Any]]:
    """Name, path and value of the fields of a state that hold networks."""
    for name in getattr(type(state), "networks", ("parameters",)):
        yield name, f"{at}.{name}", getattr(state, name)


def _is_state(value: Any) -> bool:
    return hasattr(type(value), "networks")


def _source(path: str, stored: Iterable[str]) -> str | None:
    """Path of a network in a checkpoint: its name in the state, or in the learner of a warm start."""
    name = path[path.rindex(".") :]
    for source in (name, f".learner{name}"):
        if any(is_part(leaf, [source]) for leaf in stored):
            return source
    return name if name == _PARAMETERS else None
