"""One iteration of all agents as a compiled program, laid out over the devices, with an account of its memory."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax.learning.algorithm import Learner
from drivax.learning.devices import chosen_devices, everywhere, layout, mesh_of
from drivax.learning.memory import MemoryAccount, account


@dataclass(frozen=True)
class Agents:
    """One learner with one seed or several; states of several are stacked along a leading axis.

    Attributes:
        learner: The learner.
        seeds: The seed of each.
    """

    learner: Learner
    seeds: tuple[int, ...]

    @property
    def several(self) -> bool:
        """Whether there is a leading axis."""
        return len(self.seeds) > 1

    def init(self, data: Any) -> Any:
        """The state before the first iteration."""
        if not self.several:
            return self.learner.init(data, jax.random.key(self.seeds[0]))
        keys = jnp.stack([jax.random.key(seed) for seed in self.seeds])
        return jax.vmap(self.learner.init, (None, 0))(data, keys)

    def iterate(self, data: Any, state: Any) -> tuple[Any, dict[str, Array]]:
        """The state after one iteration of all, and what each logs."""
        if not self.several:
            return self.learner.iterate(data, state)
        return jax.vmap(self.learner.iterate, (None, 0))(data, state)

    def shapes_of_one(self, shapes: Any) -> Any:
        """Shapes of the state of one agent, from those of the state of all."""
        rank = int(self.several)
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[rank:], leaf.dtype), shapes)

    def one(self, tree: Any, number: int) -> Any:
        """What belongs to one agent: of its state, a part of it, or what is logged."""
        return jax.tree.map(lambda leaf: leaf[number], tree) if self.several else tree

    def together(self, states: Sequence[Any]) -> Any:
        """The state of all, from the state of each."""
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states) if self.several else states[0]


class Program:
    """What a run executes. Compiled at once, so that what does not fit is told before anything is made.

    Args:
        agents: What learns.
        data: What is trained on.
        devices: How many devices to use; None: all, as far as there is something to divide.

    Raises:
        UsageError: The devices are not there, or cannot be divided among.
    """

    def __init__(self, agents: Agents, data: Any, devices: int | None = 1) -> None:
        self.agents = agents
        shapes = jax.eval_shape(agents.init, data)
        batch = getattr(agents.learner, "batch", None)
        self.devices = chosen_devices(devices, len(agents.seeds), shapes, batch)
        self._mesh = mesh_of(self.devices)
        self._layout: Any = None
        if len(self.devices) > 1:
            self._layout = layout(self._mesh, len(agents.seeds), shapes)
            data = jax.device_put(data, everywhere(self._mesh))
            shapes = jax.tree.map(
                lambda leaf, place: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place),
                shapes,
                self._layout,
            )
        self.data = data
        self.shapes = shapes
        outputs = None if self._layout is None else (self._layout, None)
        iterate = jax.jit(agents.iterate, donate_argnums=1, out_shardings=outputs)
        with self._divided():
            self.compiled = iterate.lower(data, shapes).compile()

    def _divided(self) -> contextlib.AbstractContextManager[Any]:
        """Lets learners ask for a division of their work, unless whole agents are divided."""
        by_environments = len(self.devices) > 1 and len(self.agents.seeds) % len(self.devices)
        return jax.set_mesh(self._mesh) if by_environments else contextlib.nullcontext()

    def account(self, validation: Any = None) -> MemoryAccount:
        """Memory on the fullest device; ``validation`` is held beside the data."""
        return account(self.data, validation, self.shapes, self.compiled, self.devices)

    def first_state(self) -> Any:
        """The state before the first iteration."""
        return jax.jit(self.agents.init, out_shardings=self._layout)(self.data)

    def state_of(self, states: Sequence[Any]) -> Any:
        """The state of all agents, from that of each."""
        state = self.agents.together(states)
        return state if self._layout is None else jax.device_put(state, self._layout)

    def step(self, state: Any) -> tuple[Any, Any]:
        """The state after one iteration, and what is logged of each agent; the old state is used up."""
        return self.compiled(self.data, state)
