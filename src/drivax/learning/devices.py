"""Several devices: agents divide among them where they can, otherwise each agent's environments do, or its batches.

Everything is one program on one mesh of devices, and the compiler divides the work by where the arrays lie. So the
result does not depend on the number of devices, but for the order of sums.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from drivax.errors import UsageError

#: With so many threads there is always one that does not wait for another.
_THREADS = 8


def widen_pool() -> None:
    """Gives XLA's pool on the CPU eight threads where cores are fewer, unless ``NPROC`` says otherwise.

    Parts of a program wait for others in the pool, and with two threads programs that train several agents side by
    side hang for ever once both wait (jaxlib 0.10.2). Other programs are slower with more threads than cores, so only
    such a training asks for it. Without effect once JAX has started.
    """
    if (os.cpu_count() or 1) < _THREADS:
        os.environ.setdefault("NPROC", str(_THREADS))


_AXIS = "devices"


def chosen_devices(wanted: int | None, agents: int, state: Any, batch: int | None = None) -> list[Any]:
    """The devices that a run uses.

    Args:
        wanted: How many; None: all of this machine's, as far as there is something to divide among them.
        agents: Number of agents.
        state: Their state, or its shapes.
        batch: Of an algorithm that learns from data alone: how many moments an update takes.

    Raises:
        UsageError: So many devices are not there, or what is to be learned cannot be divided among them.
    """
    have = jax.local_devices()
    if wanted is not None and not 1 <= wanted <= len(have):
        raise UsageError(f"{wanted} devices, but there are {len(have)}", cure=f"use 1 to {len(have)}")
    count = len(have) if wanted is None else wanted
    if count == 1 or agents % count == 0:
        return have[:count]
    sizes = {leaf.shape[axis] for leaf, axis in _divisible(state, agents) if axis is not None}
    kind = "environments" if sizes else "moments"
    sizes |= set() if batch is None else {batch}
    odd = [size for size in sizes if size % count]
    if sizes and not odd:
        return have[:count]
    if wanted is None:
        return have[:1]
    what = f"{odd[0]} {kind}" if odd else "an algorithm without environments or batches"
    cure = f"use a multiple of {count} {kind} or seeds, or fewer devices"
    raise UsageError(f"{what} cannot be divided among {count} devices", cure=cure)


def mesh_of(devices: Sequence[Any]) -> Mesh:
    """The devices in a row."""
    return Mesh(np.array(devices), (_AXIS,))


def layout(mesh: Mesh, agents: int, state: Any) -> Any:
    """Where each array of a state lies: divided by agents, by environments, or whole on every device."""
    by_agents = agents > 1 and agents % mesh.size == 0

    def place(axis: int | None) -> NamedSharding:
        if by_agents:
            axis = 0
        return NamedSharding(mesh, PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, _AXIS))

    places = [place(axis) for _, axis in _divisible(state, agents)]
    return jax.tree.unflatten(jax.tree.structure(state), places)


def everywhere(mesh: Mesh) -> NamedSharding:
    """Whole on every device."""
    return NamedSharding(mesh, PartitionSpec())


def divided(tree: Any, axis: int) -> Any:
    """The same arrays; where one agent's work is divided among devices, the compiler is asked to divide this axis.

    Without that it may well compute a whole update on every device.
    """
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.size == 1 or any(leaf.shape[axis] % mesh.size for leaf in jax.tree.leaves(tree)):
        return tree
    return jax.lax.with_sharding_constraint(tree, PartitionSpec(*[None] * axis, _AXIS))


def _divisible(state: Any, agents: int) -> list[tuple[Any, int | None]]:
    """Leaves of a state with the axis that counts environments, as the records that hold them say."""

    def axis_of(part: Any) -> int | None:
        return getattr(type(part), "environment_axis", None)

    found: list[tuple[Any, int | None]] = []
    for part in jax.tree.leaves(state, is_leaf=lambda part: axis_of(part) is not None):
        axis = axis_of(part)
        at = None if axis is None else axis + (agents > 1)
        found += [
            (leaf, at if at is not None and len(leaf.shape) > at else None) for leaf in jax.tree.leaves(part)
        ]
    return found
