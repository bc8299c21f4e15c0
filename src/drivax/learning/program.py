"""One iteration of all seeds as a compiled program: its layout over devices, and the memory that it takes.

Seeds are divided among devices where they can be, otherwise the environments or batches of each seed. Results depend
on the number of devices only through the order of sums.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jax.tree_util import keystr
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.evaluation.memory import free_memory
from drivax.learning.algorithm import Learner
from drivax.tracking.run_folder import kernels_difference
from drivax.tracking.workers import available_cores

#: Threads of XLA's pool, enough to avoid deadlocks.
_THREADS = 8
#: Flag of XLA that sets the number of CPU devices.
_DEVICE_FLAG = "--xla_force_host_platform_device_count"
#: Names of the mesh axes: devices that divide the work of each seed, and devices that divide the seeds.
_AXIS, _SEEDS = "devices", "seeds"

_NETWORKS = "networks and optimiser"
#: Settings are named without their path, which begins with ``algorithm.`` and, in a warm start, ``ppo.`` or ``sac.``.
_CURES = {
    "scenarios": "hold fewer scenarios at a time: --memory",
    "validation": "validate on fewer scenarios",
    "replay": "lower replay.capacity, or set replay.store to state",
    "environments": "lower environments",
    _NETWORKS: "choose a smaller network, or fewer --seeds",
    "program": "lower environments, unroll or batch, or raise minibatches",
}
#: Fields of a learner's state that are listed separately.
_LISTED_FIELDS = ("replay", "environments")


def widen_pool() -> None:
    """Give XLA's CPU thread pool at least eight threads, unless ``NPROC`` is set. Call it before JAX starts.

    Programs of several seeds can deadlock on a smaller pool, when every thread waits for a task that no thread is free
    to run (jaxlib 0.10.2). Do not call it for other programs: they are slower with more threads than cores.
    """
    if len(available_cores()) < _THREADS:
        os.environ.setdefault("NPROC", str(_THREADS))


def use_all_cores() -> None:
    """Make every core of this process a JAX device; has no effect once JAX has started.

    ``JAX_NUM_CPU_DEVICES`` and the flag ``--xla_force_host_platform_device_count`` in ``XLA_FLAGS`` take precedence.
    """
    if jax.config.values["jax_num_cpu_devices"] >= 0 or _DEVICE_FLAG in os.environ.get("XLA_FLAGS", ""):
        return
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", len(available_cores()))


@dataclass(frozen=True)
class Seeds:
    """One learner with one seed or several; states of several seeds are stacked along a leading axis."""

    learner: Learner
    seeds: tuple[int, ...]

    @property
    def is_stacked(self) -> bool:
        """Whether states have a leading axis."""
        return len(self.seeds) > 1

    def init(self, data: Any) -> Any:
        """Return the initial state."""
        if not self.is_stacked:
            return self.learner.init(data, jax.random.key(self.seeds[0]))
        keys = jnp.stack([jax.random.key(seed) for seed in self.seeds])
        return jax.vmap(self.learner.init, (None, 0))(data, keys)

    def iterate(self, data: Any, state: Any) -> tuple[Any, dict[str, Array]]:
        """Return the state after one iteration of all seeds, and the logs of each."""
        if not self.is_stacked:
            return self.learner.iterate(data, state)
        return jax.vmap(self.learner.iterate, (None, 0))(data, state)

    def all_finite(self, leaves: Sequence[Array]) -> Bool[Array, "*seeds"]:
        """Return whether all numbers of these leaves of the state are finite, for each seed."""
        return jax.vmap(all_finite)(leaves) if self.is_stacked else all_finite(leaves)

    def member_shapes(self, shapes: Any) -> Any:
        """Return shapes of the state of one seed, given those of all."""
        axes = int(self.is_stacked)
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[axes:], leaf.dtype), shapes)

    def member(self, tree: Any, number: int) -> Any:
        """Select one seed from a state, a part of a state, or logs."""
        return jax.tree.map(lambda leaf: leaf[number], tree) if self.is_stacked else tree

    def stack(self, states: Sequence[Any]) -> Any:
        """Return the state of all seeds, given that of each."""
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states) if self.is_stacked else states[0]


class Program:
    """An iteration of all seeds on some data, compiled before any array of the state is allocated.

    ``data`` may be replaced by others of the same shapes between two iterations (:meth:`place`).
    ``devices`` is passed to :func:`choose_devices`, whose errors are raised.
    """

    def __init__(self, seeds: Seeds, data: Any, devices: int | None = 1) -> None:
        self.seeds = seeds
        # With one device, ``initial_state`` reuses this trace.
        self._init = jax.jit(seeds.init)
        shapes = self._init.eval_shape(data)
        batch = getattr(seeds.learner, "batch", None)
        self.devices = choose_devices(devices, len(seeds.seeds), shapes, batch)
        by_seeds = len(seeds.seeds) > 1 and len(seeds.seeds) % len(self.devices) == 0
        self._mesh = Mesh(np.array(self.devices), (_SEEDS if by_seeds else _AXIS,))
        self._layout: Any = None
        if len(self.devices) > 1:
            self._layout = _layout(self._mesh, seeds.is_stacked, shapes)
            self._init = jax.jit(seeds.init, out_shardings=self._layout)
            if self.devices[0].platform == "cpu":  # devices share the memory of NumPy arrays, not of JAX's
                data = jax.tree.map(np.asarray, data)
            shapes = jax.tree.map(
                lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
                shapes, self._layout,
            )  # fmt: skip
        self.data, self.shapes = self.place(data), shapes
        outputs = None if self._layout is None else (self._layout, None, None)
        iterate = jax.jit(self._iterate, donate_argnums=1, out_shardings=outputs)
        with contextlib.nullcontext() if self._layout is None else jax.set_mesh(self._mesh):
            self.compiled = iterate.lower(self.data, shapes).compile()

    def _iterate(self, data: Any, state: Any) -> tuple[Any, Any, Bool[Array, "*seeds"]]:
        """Iterate whole seeds on each device; learners divide their work themselves if seeds cannot be divided."""
        run = self.seeds.iterate
        if self._layout is not None and _SEEDS in self._mesh.axis_names:
            specs = (PartitionSpec(), PartitionSpec(_SEEDS))
            run = jax.shard_map(run, in_specs=specs, out_specs=specs[1], check_vma=False)
        after, logs = run(data, state)
        return after, logs, self.seeds.all_finite(isolated_leaves(after))

    def account(self, validation: Any = None) -> MemoryAccount:
        """Return the memory of the fullest device, with ``validation`` held next to the data."""
        return account(self.data, validation, self.shapes, self.compiled, self.devices)

    def place(self, data: Any) -> Any:
        """Return data of the iterations on every device."""
        if self._layout is None:
            return data
        return jax.device_put(data, NamedSharding(self._mesh, PartitionSpec()))

    def initial_state(self) -> Any:
        """Return the initial state of all seeds."""
        return self._init(self.data)

    def state_of(self, states: Sequence[Any]) -> Any:
        """Return the state of all seeds, laid out over the devices, given that of each."""
        return self.arrange(self.seeds.stack(states))

    def arrange(self, state: Any) -> Any:
        """Return a changed state in the layout of the program."""
        return state if self._layout is None else jax.device_put(state, self._layout)

    def step(self, state: Any) -> tuple[Any, Any, Bool[Array, "*seeds"]]:
        """Return the state after one iteration, and of each seed the logs and whether all trained leaves are finite.

        The old state is donated.
        """
        return self.compiled(self.data, state)


def trained_leaves(state: Any) -> dict[str, Any]:
    """Return the floating-point leaves of a state (or its shapes) by name, except environments and replay buffer.

    Environments hold NaN and infinity for values that are not defined yet.
    """
    return {
        keystr(path): leaf
        for path, leaf in jax.tree.leaves_with_path(state)
        if jnp.issubdtype(leaf.dtype, jnp.floating) and _listed_field(path) is None
    }


def isolated_leaves(state: Any) -> list[Array]:
    """Return the trained leaves of a state, for a check in the program of its iteration.

    Fused with the iteration, the check could change how parameters are rounded.
    """
    return jax.lax.optimization_barrier(list(trained_leaves(state).values()))


def all_finite(leaves: Sequence[Array]) -> Bool[Array, ""]:
    """Return whether all numbers are finite."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in leaves]).all() if leaves else jnp.asarray(True)


def _listed_field(path: Sequence[Any]) -> str | None:
    """Return the listed field that contains a leaf; None if there is none."""
    return next((key.name for key in path if getattr(key, "name", "") in _LISTED_FIELDS), None)


def choose_devices(requested: int | None, seeds: int, state: Any, batch: int | None = None) -> list[Any]:
    """Return the requested number of devices; None: the most local devices that the work can be divided among.

    Work is divided by seeds, by environments of their state (or its shapes), or by the batch of an offline algorithm.
    Raises UsageError if there are fewer devices, or the work cannot be divided among them.
    """
    available = jax.local_devices()
    if requested is not None and not 1 <= requested <= len(available):
        problem = f"{requested} devices, but there are {len(available)}"
        raise UsageError(problem, cure=f"use 1 to {len(available)}")
    divisible = ((leaf, axis) for leaf, axis in _divisible(state, seeds > 1) if axis is not None)
    sizes = [(leaf.shape[axis], "environments") for leaf, axis in divisible]
    sizes += [] if batch is None else [(batch, "steps per batch")]

    def divides(count: int) -> bool:
        by_sizes = bool(sizes) and all(size % count == 0 for size, _ in sizes)
        return count == 1 or seeds % count == 0 or by_sizes

    count = requested or max(filter(divides, range(1, len(available) + 1)))
    if divides(count):
        return available[:count]
    indivisible = [f"{size} {kind}" for size, kind in sizes if size % count]
    work = indivisible[0] if indivisible else "an algorithm without environments or batches"
    kinds = " or ".join(dict.fromkeys([*(kind for size, kind in sizes if size % count), "seeds"]))
    cure = f"use a multiple of {count} {kinds}, or fewer devices"
    raise UsageError(f"{work} cannot be divided among {count} devices", cure=cure)


def former_devices(info: Mapping[str, Any]) -> int:
    """Return the number of devices of a run, given its ``run.json``."""
    return int(info.get("devices") or 1)  # Runs of version 0.1.0 lack it; those on a CPU used one.


def warn_of_other_bits(infos: Sequence[Mapping[str, Any]], devices: int, log: Callable[[str], None]) -> None:
    """Warn if a run to resume used other native kernels or another number of devices.

    ``infos`` are the ``run.json`` of its folders, of which the first is read; none for a new run.
    """
    for info in infos[:1]:
        differences = [kernels_difference(info)]
        if (former := former_devices(info)) != devices:
            differences.append(f"the run used {former} devices, this process {devices}")
        for difference in filter(None, differences):
            log(f"warning: {difference}: the result differs in bits from that of an uninterrupted run")


def shard_axis(tree: Any, axis: int) -> Any:
    """Shard an axis over the devices that one seed is divided among; values do not change.

    Without this constraint the compiler may compute the whole update on every device.
    """
    count = device_count()
    if count == 1 or any(leaf.shape[axis] % count for leaf in jax.tree.leaves(tree)):
        return tree
    return jax.lax.with_sharding_constraint(tree, _divided_along(axis))


def device_count() -> int:
    """Return the number of devices that one seed is divided among, while its iteration is traced."""
    mesh = jax.sharding.get_abstract_mesh()
    return 1 if mesh.empty or AxisType.Manual in mesh.axis_types else mesh.size


def is_largest(name: str) -> bool:
    """Return whether a logged value is a maximum over samples and updates instead of a mean, by its name."""
    return name.startswith("largest_")


def sum_over_devices(
    function: Callable[[Any, Any], tuple[dict[str, Array], Any]], whole: Any, divided: Any, axis: int
) -> tuple[dict[str, Array], Any]:
    """Return the logs and sums of ``function``, added over devices that divide ``divided`` along an axis.

    Logs, sums and ``whole`` are floating-point numbers. Logs ``largest_*`` are maxima, NaN if any is NaN. Devices
    exchange sums once, as one vector, and likewise the gradient of a sum; the compiler would do so in every step of a
    loop. If the axis does not divide evenly, nothing is divided.
    """
    count = device_count()
    if count == 1 or any(leaf.shape[axis] % count for leaf in jax.tree.leaves(divided)):
        return function(whole, divided)
    specs = (_divided_along(None), _divided_along(axis))
    # Devices wait for each other once per array: parameters and sums are exchanged as one vector each.
    parameters, unravel_parameters = ravel_pytree(whole)

    @partial(jax.shard_map, in_specs=specs, out_specs=PartitionSpec(), check_vma=False)
    def summed(parameters: Array, share: Any) -> Any:
        logs, sums = function(unravel_parameters(parameters), share)
        # A maximum has an element per device in the vector: ``pmax`` loses NaN on CPUs.
        is_own = jax.lax.axis_index(_AXIS) == jnp.arange(count)
        maxima = {n: jnp.where(is_own, log, 0.0) for n, log in logs.items() if is_largest(n)}
        vector, unravel = ravel_pytree((logs | maxima, sums))
        total_logs, total = unravel(jax.lax.psum(vector, _AXIS))
        return {n: log.max() if is_largest(n) else log for n, log in total_logs.items()}, total

    return summed(parameters, divided)


def compute_on_each_device(function: Callable[..., Any], *whole: Any) -> Any:
    """Return ``function(*whole)``, computed by every device from whole arrays, so that its sums need no exchange."""
    if device_count() == 1:
        return function(*whole)
    return jax.shard_map(function, in_specs=PartitionSpec(), out_specs=PartitionSpec(), check_vma=False)(
        *whole
    )


def mean_over_devices(x: Array) -> Float[Array, ""]:
    """Return the mean of an array over all devices, also where :func:`sum_over_devices` gives each device a share.

    No gradient flows through it.
    """
    mean = jax.lax.stop_gradient(jnp.mean(x))
    return jax.lax.pmean(mean, _AXIS) if _AXIS in jax.sharding.get_abstract_mesh().manual_axes else mean


def map_over_devices(
    function: Callable[..., Any],
    *arguments: Any,
    in_axes: Sequence[int | None] = (None, 0),
    out_axis: int = 0,
) -> Any:
    """Return ``function(*arguments)``, computed by each device for its share of the arguments.

    Arrays of an argument are divided along its entry of ``in_axes`` (None: every device has them whole), those of the
    result along ``out_axis``. A result that is a sum over this axis differs between devices: give it an axis of size 1.
    If an axis does not divide evenly, nothing is divided.
    """
    count, pairs = device_count(), list(zip(arguments, in_axes, strict=True))
    sizes = [leaf.shape[axis] for tree, axis in pairs if axis is not None for leaf in jax.tree.leaves(tree)]
    if count == 1 or any(size % count for size in sizes):
        return function(*arguments)
    specs = tuple(map(_divided_along, in_axes))
    mapped = jax.shard_map(function, in_specs=specs, out_specs=_divided_along(out_axis), check_vma=False)
    return mapped(*arguments)


def _divided_along(axis: int | None) -> PartitionSpec:
    """Return the layout of arrays that devices divide along an axis; None: that every device has whole."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, _AXIS)


def read_columns(
    read: Callable[[Any, Array, Array], Any], ring: Any, row: Int[Array, "*batch"],
    column: Int[Array, "*batch"],
) -> Any:  # fmt: skip
    """Return ``read(ring, row, column)`` of arrays ``[row, column, ...]`` that devices may divide by columns.

    ``read`` returns arrays ``[*batch, ...]``, each element read from its own column only. The result is whole on every
    device: each device evaluates ``read`` on its columns, and their bits are summed, with zeros for other columns. The
    compiler would exchange the index for every leaf instead. Columns must be in range.
    """
    count, shapes = device_count(), jax.eval_shape(read, ring, row, column)
    is_divided = count > 1 and all(leaf.shape[1] % count == 0 for leaf in jax.tree.leaves(ring))
    if not is_divided or not all(_fits_integer(leaf.dtype) for leaf in jax.tree.leaves(shapes)):
        return read(ring, row, column)
    specs = (_divided_along(1), _divided_along(None))

    @partial(jax.shard_map, in_specs=specs, out_specs=PartitionSpec(), check_vma=False)
    def exchange(share: Any, index: tuple[Array, Array]) -> Any:
        size = jax.tree.leaves(share)[0].shape[1]
        local_column = index[1] - size * jax.lax.axis_index(_AXIS)
        is_own = (local_column >= 0) & (local_column < size)

        def bits(leaf: Array) -> Array:
            value = leaf.view(_integer_type(leaf.dtype)).astype(jnp.int32)
            return jnp.where(is_own.reshape(*is_own.shape, *[1] * (value.ndim - is_own.ndim)), value, 0)

        columns = read(share, index[0], jnp.clip(local_column, 0, size - 1))
        vector, unravel = ravel_pytree(jax.tree.map(bits, columns))
        return unravel(jax.lax.psum(vector, _AXIS))

    return jax.tree.map(
        lambda leaf, bits: bits.astype(_integer_type(leaf.dtype)).view(leaf.dtype),
        shapes, exchange(ring, (row, column)),
    )  # fmt: skip


def _fits_integer(dtype: Any) -> bool:
    """Return whether a 32-bit integer holds the bits of a value: not of random keys, complex or 64-bit numbers."""
    is_number = any(jnp.issubdtype(dtype, kind) for kind in (jnp.floating, jnp.integer, jnp.bool_))
    return is_number and dtype.itemsize <= 4


def _integer_type(dtype: Any) -> Any:
    """Return the integer type of the same size."""
    return jnp.dtype(f"int{8 * dtype.itemsize}")


def _layout(mesh: Mesh, is_stacked: bool, state: Any) -> Any:
    """Return the sharding of each array of a state: divided by seeds, by environments, or whole on every device."""
    (name,) = mesh.axis_names
    axes = (0 if name == _SEEDS else axis for _, axis in _divisible(state, is_stacked))
    specs = [PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, name) for axis in axes]
    return jax.tree.unflatten(jax.tree.structure(state), [NamedSharding(mesh, spec) for spec in specs])


def _divisible(state: Any, is_stacked: bool) -> list[tuple[Any, int | None]]:
    """Return each leaf of a state with its axis of environments, which its record declares, or None."""

    def axis_of(node: Any) -> int | None:
        return getattr(type(node), "environment_axis", None)

    leaves: list[tuple[Any, int | None]] = []
    for node in jax.tree.leaves(state, is_leaf=lambda node: axis_of(node) is not None):
        axis = axis_of(node)
        axis = None if axis is None else axis + is_stacked
        for leaf in jax.tree.leaves(node):
            leaves.append((leaf, axis if axis is not None and len(leaf.shape) > axis else None))
    return leaves


@dataclass(frozen=True)
class MemoryAccount:
    """Bytes that a run takes on its fullest device, by purpose, and bytes that are free for it (None: unknown)."""

    sizes: Mapping[str, int]
    limit: int | None
    device: str

    @property
    def total(self) -> int:
        """Sum of all bytes."""
        return sum(self.sizes.values())

    def text(self) -> str:
        """Return the account as one line."""
        sizes = ", ".join(f"{name} {_format_bytes(size)}" for name, size in self.sizes.items() if size)
        limit = "" if self.limit is None else f" of {_format_bytes(self.limit)} free"
        return f"memory: {_format_bytes(self.total)}{limit} on {self.device}: {sizes}"

    @property
    def cure(self) -> str:
        """Return the cure that reduces the largest entry."""
        return _CURES[max(self.sizes, key=lambda name: self.sizes[name])]

    def check(self) -> None:
        """Raise UsageError if the run does not fit, with a cure for its largest entry."""
        if self.limit is not None and self.total > self.limit:
            raise UsageError(f"training does not fit; {self.text()}", cure=self.cure)


def account(
    data: Any, validation: Any, state: Any, compiled: jax.stages.Compiled, devices: Sequence[Any]
) -> MemoryAccount:
    """Return the memory of a run: training data on every device, validation data on the first, state, and iteration.

    ``state`` may be the shapes of the learners' state with their sharding.
    """
    sizes = {"scenarios": _bytes(data), "validation": _bytes(validation)} | dict.fromkeys(
        (*_LISTED_FIELDS, _NETWORKS), 0
    )
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        sizes[_listed_field(path) or _NETWORKS] += _leaf_bytes(leaf)
    sizes["program"] = _program_bytes(compiled)
    device, free = devices[0], free_memory(devices[0], len(devices))
    # Scenarios are already in memory, so they do not count as free; the rest is not allocated yet.
    limit = None if free is None else free + sizes["scenarios"] + sizes["validation"]
    return MemoryAccount(sizes, limit, f"{device.platform}:{device.id}")


def _bytes(tree: Any) -> int:
    return sum(_leaf_bytes(leaf) for leaf in jax.tree.leaves(tree))


def _leaf_bytes(leaf: Any) -> int:
    """Return the bytes of an array, or of its shard on one device."""
    sharding = getattr(leaf, "sharding", None)
    shape = leaf.shape if sharding is None else sharding.shard_shape(leaf.shape)
    return math.prod(shape) * leaf.dtype.itemsize


def _program_bytes(compiled: jax.stages.Compiled) -> int:
    """Return the bytes of temporary values, of results that replace no argument, and of the program itself."""
    analysis = compiled.memory_analysis()
    if analysis is None:
        return 0
    results = analysis.output_size_in_bytes - analysis.alias_size_in_bytes
    return analysis.temp_size_in_bytes + results + analysis.generated_code_size_in_bytes


def _format_bytes(size: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}" if size < 10 * scale else f"{size / scale:.0f} {unit}"
    return f"{size} B"
