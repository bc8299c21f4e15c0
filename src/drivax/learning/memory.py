"""How much memory a training run takes, told before it starts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax

from drivax.errors import UsageError
from drivax.evaluation.memory import memory_of

_CURES = {
    "scenarios": "train on fewer scenarios",
    "validation": "validate on fewer scenarios",
    "replay": "lower algorithm.replay.capacity, or set algorithm.replay.store to state",
    "environments": "lower algorithm.environments",
    "networks and optimiser": "choose a smaller network, or fewer --seeds",
    "program": "lower algorithm.environments, unroll or batch, or raise algorithm.minibatches",
}
#: Fields of a learner's state that have a line of their own.
_FIELDS = ("replay", "environments")
_REST = "networks and optimiser"


@dataclass(frozen=True)
class MemoryAccount:
    """Bytes that a run takes on its fullest device.

    Attributes:
        parts: Bytes by what takes them; ``program`` is what an iteration needs beside the others, as compiled.
        limit: What the device has; None where it does not say.
        device: Its name.
    """

    parts: Mapping[str, int]
    limit: int | None
    device: str

    @property
    def total(self) -> int:
        """Bytes altogether."""
        return sum(self.parts.values())

    def text(self) -> str:
        """One line."""
        parts = ", ".join(f"{name} {_readable(size)}" for name, size in self.parts.items() if size)
        of = "" if self.limit is None else f" of {_readable(self.limit)}"
        return f"memory: {_readable(self.total)}{of} on {self.device}: {parts}"

    def refuse_too_much(self) -> None:
        """Refuses a run that does not fit.

        Raises:
            UsageError: It does not; the cure is about the largest part.
        """
        if self.limit is not None and self.total > self.limit:
            largest = max(self.parts, key=lambda name: self.parts[name])
            raise UsageError(f"training does not fit; {self.text()}", cure=_CURES[largest])


def account(
    data: Any, validation: Any, state: Any, compiled: jax.stages.Compiled, devices: Sequence[Any]
) -> MemoryAccount:
    """The account of a run.

    Args:
        data: What is trained on, whole on every device.
        validation: What is validated on, on the first device.
        state: The learners' state: its shapes, with where they lie.
        compiled: One iteration.
        devices: What it runs on.
    """
    parts = {"scenarios": _bytes(data), "validation": _bytes(validation), "replay": 0, "environments": 0}
    parts[_REST] = 0
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        names = [getattr(key, "name", "") for key in path]
        parts[next((name for name in names if name in _FIELDS), _REST)] += _leaf_bytes(leaf)
    parts["program"] = _beside(compiled)
    device = devices[0]
    return MemoryAccount(parts, memory_of(device, len(devices)), f"{device.platform}:{device.id}")


def _bytes(tree: Any) -> int:
    return sum(_leaf_bytes(leaf) for leaf in jax.tree.leaves(tree))


def _leaf_bytes(leaf: Any) -> int:
    """Bytes of an array, or of its part on one device."""
    sharding = getattr(leaf, "sharding", None)
    shape = leaf.shape if sharding is None else sharding.shard_shape(leaf.shape)
    return math.prod(shape) * leaf.dtype.itemsize


def _beside(compiled: jax.stages.Compiled) -> int:
    """Bytes of temporary values, of results that take no argument's place, and of the program itself."""
    found = compiled.memory_analysis()
    if found is None:
        return 0
    results = found.output_size_in_bytes - found.alias_size_in_bytes
    return found.temp_size_in_bytes + results + found.generated_code_size_in_bytes


def _readable(size: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}" if size < 10 * scale else f"{size / scale:.0f} {unit}"
    return f"{size} B"
