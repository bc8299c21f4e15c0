"""What a run begins with: a state of its own, or one with the networks of another run and all else fresh."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from drivax.errors import DataError, UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.policies import PACKED, open_policy
from drivax.learning.program import Program
from drivax.tracking.checkpoints import Checkpoints, is_part
from drivax.tracking.run_folder import run_and_step, trained_on

_PARAMETERS = ".parameters"


@dataclass(frozen=True)
class Origin:
    """A checkpoint of another run.

    Attributes:
        run: Its folder.
        step: The checkpoint's.
        data: The data sets that it was trained on, as its ``run.json`` names them.
    """

    run: Path
    step: int
    data: list[dict[str, Any]]

    @classmethod
    def of(cls, name: str) -> Origin:
        """That of ``RUN`` (the best, or the newest without a validation) or ``RUN@STEP``.

        Raises:
            UsageError: It holds several agents, or what only drives.
            DataError: It is no training run, or has no checkpoint.
        """
        run, step = run_and_step(name)
        folder, _ = open_policy(run)
        if (folder.path / PACKED).is_file():
            raise UsageError(
                "is packed, and has no networks to learn on from", file=run, cure="name the run itself"
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
        """For ``run.json``."""
        return {"run": str(self.run), "step": self.step, "data": self.data}

    def networks(self, state: Any) -> dict[str, Any]:
        """The stored networks, by the paths of those that they replace in a fresh state of one agent (or its shapes).

        Networks of which the checkpoint has none are left out: a critic, where the other run only imitated.

        Raises:
            DataError: They do not fit; names the first array that does not.
        """
        checkpoints = Checkpoints(self.run / "checkpoints")
        stored = [leaf["name"] for leaf in checkpoints.about(self.step)["leaves"]]
        parts = _networks(state)
        sources = {path: source for path in parts if (source := _source(path, stored))}
        templates = {source: parts[path] for path, source in sources.items()}
        cure = "begin from a run with the same network, observation and actions"
        found = checkpoints.restore_parts(templates, self.step, cure)
        return {path: found[source] for path, source in sources.items()}


def with_step(config: TrainConfig) -> TrainConfig:
    """The configuration with the step of the run that it begins from, so that whoever resumes finds the same one.

    Raises:
        UsageError, DataError: As :meth:`Origin.of`.
    """
    if config.begin_from is None:
        return config
    return replace(config, begin_from=str(Origin.of(config.begin_from)))


def inherited(begin_from: str | None, program: Program, say: Callable[[str], None]) -> dict[str, Any]:
    """The networks of the run that another one is to begin from, by their paths in the state; none without one.

    Args:
        begin_from: ``RUN`` or ``RUN@STEP``.
        program: What is to be trained.
        say: Told which networks those are.

    Raises:
        UsageError, DataError: As :meth:`Origin.of` and :meth:`Origin.networks`.
    """
    if begin_from is None:
        return {}
    origin = Origin.of(begin_from)
    networks = origin.networks(program.agents.shapes_of_one(program.shapes))
    say(f"begins with {', '.join(path.removeprefix('.') for path in networks)} of {origin}")
    return networks


def first_state(program: Program, networks: Mapping[str, Any]) -> Any:
    """The state of all agents before the first iteration, all of them with these networks in the place of their own."""
    fresh, agents = program.first_state(), program.agents
    if not networks:
        return fresh
    states = [with_networks(agents.one(fresh, number), networks) for number in range(len(agents.seeds))]
    return program.state_of(states)


def with_networks(state: Any, networks: Mapping[str, Any], at: str = "") -> Any:
    """A state with these networks, by their paths, in the place of its own."""
    parts = {
        name: with_networks(part, networks, path) if _is_state(part) else networks.get(path, part)
        for name, path, part in _fields(state, at)
    }
    return replace(state, **parts)


def _networks(state: Any, at: str = "") -> dict[str, Any]:
    """The networks of a state by their paths."""
    found: dict[str, Any] = {}
    for _, path, part in _fields(state, at):
        if _is_state(part):
            found |= _networks(part, path)
        elif jax.tree.leaves(part):
            found[path] = part
    return found


def _fields(state: Any, at: str) -> Iterable[tuple[str, str, Any]]:
    """The fields of a state that hold networks: name, path and value."""
    for name in getattr(type(state), "networks", ("parameters",)):
        yield name, f"{at}.{name}", getattr(state, name)


def _is_state(part: Any) -> bool:
    return hasattr(type(part), "networks")


def _source(path: str, stored: Iterable[str]) -> str | None:
    """Where a checkpoint has a network: under its name in the state, or in that of the learner within a warm start."""
    name = path[path.rindex(".") :]
    for source in (name, f".learner{name}"):
        if any(is_part(leaf, [source]) for leaf in stored):
            return source
    return name if name == _PARAMETERS else None
