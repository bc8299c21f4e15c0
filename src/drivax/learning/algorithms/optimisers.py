"""Gradients accumulated over chunks, Adam with clipping and a linear schedule, and averages of parameters.

The average is validated and exported in place of the parameters that are trained. States of algorithms with an average
have fields ``parameters`` (of the planner), ``trained`` (None without an average) and ``iteration``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from drivax.errors import UsageError
from drivax.learning.algorithm import AuxiliaryLoss
from drivax.learning.program import device_count, is_largest, sum_over_devices

#: Largest number of samples per chunk and CPU device, so that intermediate results fit the second-level cache.
_CHUNK = 64


def chunk_size(batch: int) -> int:
    """Return the number of samples whose gradient is computed at a time: on GPUs the whole batch.

    On CPUs it is the largest divisor of the batch with 17 to 64 samples per device; if there is none, the whole batch.
    """
    devices = device_count()
    sizes = range(_CHUNK * devices, _CHUNK * devices // 4, -devices)
    dividing = (size for size in sizes if batch % size == 0)
    return next(dividing, batch) if jax.default_backend() == "cpu" else batch


def in_chunks(batch: Any) -> Any:
    """Return a batch (leaves ``[sample, ...]``) as chunks ``[chunk, sample, ...]`` for :func:`sum_gradients`.

    Each device has a consecutive share of the batch, and every chunk equally many samples of each share, so that no
    sample moves to another device.
    """
    count = len(jax.tree.leaves(batch)[0])
    size = chunk_size(count)
    devices = device_count() if size % device_count() == 0 else 1

    def divide(leaf: Array) -> Array:
        shares = leaf.reshape(devices, count // size, size // devices, *leaf.shape[1:])
        return jnp.swapaxes(shares, 0, 1).reshape(-1, size, *leaf.shape[1:])

    return jax.tree.map(divide, batch)


def sum_gradients(
    loss: Callable[[Any, Any], tuple[Array, dict[str, Array]]], parameters: Any, samples: Any
) -> tuple[dict[str, Array], Any]:
    """Return the sums of logs and gradients of a loss over ``samples`` (leaves ``[chunk, sample, ...]``).

    The loss of a batch must be the sum of those of its chunks; logs ``largest_*`` are maxima. Devices divide the
    samples of each chunk.
    """
    gradient = jax.grad(loss, has_aux=True)

    def sum_chunks(parameters: Any, samples: Any) -> tuple[dict[str, Array], Any]:
        def add(sums: Any, chunk: Any) -> tuple[Any, None]:
            return _combine(sums, gradient(parameters, chunk)[::-1]), None

        first_chunk = jax.tree.map(lambda leaf: leaf[0], samples)
        if jax.tree.leaves(samples)[0].shape[0] == 1:
            return gradient(parameters, first_chunk)[::-1]
        shapes = jax.eval_shape(gradient, parameters, first_chunk)[::-1]
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        return jax.lax.scan(add, zeros, samples)[0]

    # Without barriers the compiler fuses these sums with the program around them, and each program rounds differently.
    inputs = jax.lax.optimization_barrier((parameters, samples))
    return jax.lax.optimization_barrier(sum_over_devices(sum_chunks, *inputs, axis=1))


def mean_gradients(
    loss: Callable[[Any, Any], tuple[Array, dict[str, Array]]], parameters: Any, samples: Any
) -> tuple[dict[str, Array], Any]:
    """Return logs and gradient as :func:`sum_gradients` does, for a loss and logs that are means over samples."""
    count = math.prod(jax.tree.leaves(samples)[0].shape[:2])

    def share_of_loss(parameters: Any, chunk: Any) -> tuple[Array, dict[str, Array]]:
        share = len(jax.tree.leaves(chunk)[0]) / count
        value, logs = loss(parameters, chunk)
        return share * value, {n: x if is_largest(n) else share * x for n, x in logs.items()}

    return sum_gradients(share_of_loss, parameters, samples)


def _combine(sums: tuple[dict[str, Array], Any], values: Any) -> tuple[dict[str, Array], Any]:
    """Return the sums of logs and gradients, but the maxima of logs ``largest_*``."""
    logs, gradient = jax.tree.map(jnp.add, sums, values)
    largest = {n: jnp.maximum(log, values[0][n]) for n, log in sums[0].items() if is_largest(n)}
    return logs | largest, gradient


def add_auxiliary(
    loss: AuxiliaryLoss | None, parameters: Any, key: Array, logs: dict[str, Array], gradient: Any
) -> tuple[dict[str, Array], Any]:
    """Add the values that an auxiliary loss logs to ``logs``, and its gradient to ``gradient``."""
    if loss is None:
        return logs, gradient
    auxiliary_gradient, auxiliary_logs = jax.grad(loss, has_aux=True)(parameters, key)
    return auxiliary_logs | logs, jax.tree.map(jnp.add, gradient, auxiliary_gradient)


def clipped_adam(
    rate: float, norm: float | None, *, updates: int = 0, last: float = 0.1, eps: float = 1e-8,
    per_network: bool = False,
) -> optax.GradientTransformation:  # fmt: skip
    """Return Adam (Kingma and Ba 2015) with gradient clipping.

    Args:
        rate: Initial learning rate.
        norm: Maximum global norm of gradients; None: no clipping.
        updates: Updates over which the rate decays linearly; it is constant afterwards. 0: always constant.
        last: Final rate relative to ``rate``.
        eps: Epsilon of Adam.
        per_network: Clip each network by its own norm, for networks that share nothing: the value's gradient is often a
            hundred times the policy's, and a joint norm would shrink the policy's steps.
    """
    schedule = optax.linear_schedule(rate, last * rate, updates) if updates else rate
    # One vector instead of dozens of arrays: every device computes the whole step.
    adam = optax.flatten(optax.adam(schedule, eps=eps))
    if norm is None:  # ``identity`` gives the state the structure that it has with clipping
        return optax.chain(optax.identity(), adam)
    return optax.chain(clip_per_network(norm) if per_network else optax.clip_by_global_norm(norm), adam)


def clip_per_network(norm: float) -> optax.GradientTransformation:
    """Clip each network (the first level of the tree) by its own global norm."""

    def clip(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        paths, structure = jax.tree_util.tree_flatten_with_path(updates)
        squares: dict[Any, Any] = {}
        for path, leaf in paths:
            squares[path[0]] = squares.get(path[0], 0.0) + jnp.sum(leaf * leaf)
        # The factor is 1 within the norm, and for a zero gradient.
        scale = {name: norm / jnp.maximum(jnp.sqrt(square), norm) for name, square in squares.items()}
        return jax.tree.unflatten(structure, [leaf * scale[path[0]] for path, leaf in paths]), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), clip)


def check_decay_share(share: float) -> None:
    """Raise UsageError if the share of a run over which a rate decays is outside (0, 1]."""
    if not 0.0 < share <= 1.0:
        raise UsageError(f"decay_share is {share}", cure="use more than 0 and at most 1")


def check_average(decay: float) -> None:
    """Raise UsageError if the decay of an average is outside [0, 1)."""
    if not 0.0 <= decay < 1.0:
        raise UsageError(f"average is {decay}", cure="use 0 or more, and less than 1")


def unless_first(state: Any, parameters: Any) -> Any:
    """Return ``parameters``, or in the first iteration those of the planner, which pretraining may have set."""
    return jax.tree.map(partial(jnp.where, state.iteration == 0), state.parameters, parameters)


def trained_parameters(state: Any) -> Any:
    """Return the parameters that are trained."""
    return state.parameters if state.trained is None else unless_first(state, state.trained)


def average(state: Any, trained: Any, decay: float) -> dict[str, Any]:
    """Return ``parameters`` and ``trained`` after an iteration that begins in ``state`` and ends with ``trained``.

    The average is the mean over all iterations for the first ``1 / (1 - decay)`` of them, then exponential.
    """
    if state.trained is None:
        return {"parameters": trained, "trained": None}
    rate = jnp.maximum(1.0 - decay, 1.0 / (state.iteration + 1))
    return {"parameters": optax.incremental_update(trained, state.parameters, rate), "trained": trained}
