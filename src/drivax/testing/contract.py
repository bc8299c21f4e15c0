"""Rules of pure functions that all checks share, and their error messages."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from drivax.errors import DrivaxError
from drivax.plugins import find_named

#: Tolerances for another order of summation, and for worlds rotated in float32.
TOLERANCE, ROTATION_TOLERANCE = 1e-4, 5e-3
#: Share of moments at which the result of a threshold may differ in a rotated world.
_MAX_FLIPS = 0.05
#: Changes of a world that must not affect results, and cures, in the order of the variants in ``worlds``.
_VARIANTS = (
    ("the rows of absent agents change", "mask with frame.valid first"),
    ("empty slots are added", "mask with frame.valid, also before a mean"),
    (
        "the order of agents changes",
        "make results independent of slots: sort by distance, or reduce over all",
    ),
)
_TRACING_ERRORS = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
)


class BrokenContract(DrivaxError, AssertionError):
    """A component violates a rule; the message names the rule and the cure."""


def expect(condition: Any, problem: str, cure: str) -> None:
    """Raise :class:`BrokenContract` unless a condition holds."""
    if not condition:
        raise BrokenContract(problem, cure=cure)


def instance(component: Any) -> Any:
    """Return a component, given itself, its class, or the dotted name of either."""
    component = find_named(component) if isinstance(component, str) else component
    return component() if isinstance(component, type) else component


def label(function: Any) -> str:
    """Return the name of a function, or else of its class, for messages."""
    return getattr(function, "__name__", type(function).__name__)


@contextlib.contextmanager
def _tracing_errors(what: str) -> Iterator[None]:
    """Turn tracing errors of JAX into :class:`BrokenContract`."""
    try:
        yield
    except _TRACING_ERRORS as error:
        problem = f"{what} cannot be compiled: Python needs the value of a traced array"
        cure = "use jnp.where instead of if, and jnp instead of numpy, float() or int()"
        raise BrokenContract(problem, cure=cure) from error


def array_type(leaf: Any) -> str:
    """Return dtype and shape of an array as text, for example ``float32[3, 2]``."""
    return f"{leaf.dtype}{list(leaf.shape)}"


def layout(tree: Any) -> Any:
    """Return structure, dtypes and shapes of a tree, for comparisons."""
    return jax.tree.structure(tree), [array_type(leaf) for leaf in jax.tree.leaves(tree)]


def program(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a newly jitted function with NumPy results; it raises :class:`BrokenContract` if tracing fails."""
    run = jax.jit(lambda *values: function(*values))

    def call(*arguments: Any) -> Any:
        with _tracing_errors(what):
            return jax.device_get(run(*arguments))

    return call


def result_shapes(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return shapes and dtypes of a function's results; raise :class:`BrokenContract` if tracing fails."""
    with _tracing_errors(what):
        return jax.eval_shape(function, *arguments)


class BatchedFunction:
    """A compiled and batched function, called ``what`` in messages; ``in_axes`` as in ``jax.vmap``."""

    def __init__(
        self, what: str, function: Callable[..., Any], in_axes: tuple[int | None, ...] = (0,)
    ) -> None:
        self.what, self.function, self.in_axes = what, function, in_axes
        self._batched = jax.vmap(function, in_axes)
        self._run = program(what, self._batched)

    def __call__(self, *arguments: Any) -> Any:
        """Return the results of all rows as NumPy arrays."""
        return self._run(*arguments)

    def check_pure(self, *arguments: Any) -> Any:
        """Check that results do not depend on compilation, batching or repetition, and return them."""
        what, results = self.what, self(*arguments)
        repeated_results = program(what, self._batched)(*arguments)
        cure = "use no random numbers but those of a fixed key, and keep no state between calls"
        expect(are_same(results, repeated_results, 0.0), f"{what} is not deterministic", cure)
        first_row = [
            argument if axis is None else jax.tree.map(lambda leaf: leaf[0], argument)
            for argument, axis in zip(arguments, self.in_axes, strict=True)
        ]
        first_result = jax.tree.map(lambda leaf: leaf[0], results)
        single_result = program(what, self.function)(*first_row)
        cure = "write it for one agent in one scenario; vmap adds the batch"
        expect(are_same(first_result, single_result, TOLERANCE), f"{what} differs in a batch", cure)
        eager_result = jax.device_get(self.function(*first_row))
        cure = "let the result depend on the arguments only"
        expect(are_same(first_result, eager_result, TOLERANCE), f"{what} differs when compiled", cure)
        return results


def check_numbers(what: str, values: Any, operation: str = "a division, a root or a logarithm") -> None:
    """Check that all values are finite."""
    for leaf in jax.tree.leaves(values):
        invalid = ~np.isfinite(leaf)
        if invalid.any():
            rows = invalid.reshape(len(leaf), -1).any(axis=1) if leaf.ndim else invalid[None]
            problem = f"{what} is not finite in {int(rows.sum())} of {len(rows)} rows"
            raise BrokenContract(problem, cure=f"guard {operation} with jnp.where on its input")


def check_variants(
    what: str, results: Any, variants: Sequence[Any], run: Callable[[Callable[..., Any]], Any]
) -> None:
    """Check that ``run`` has the same results for ``worlds.BANK_VARIANTS`` or ``worlds.FRAME_VARIANTS``."""
    for variant, (cause, cure) in zip(variants, _VARIANTS, strict=True):
        check_same(what, results, run(variant), cause, cure)


def check_same(what: str, result: Any, other: Any, cause: str, cure: str) -> None:
    """Check that two results agree at all moments; ``cause`` completes the message "changes when"."""
    expect(are_same(result, other, TOLERANCE), f"{what} changes when {cause}", cure)


def check_rotated(what: str, result: Any, rotated: Any) -> None:
    """Check that results agree in a rotated and shifted world, except at up to 5 % of the moments: thresholds flip."""
    agrees = np.ones(len(jax.tree.leaves(result)[0]), bool)
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(rotated), strict=True):
        is_close = np.isclose(a, b, rtol=ROTATION_TOLERANCE, atol=ROTATION_TOLERANCE)
        agrees &= is_close.reshape(len(agrees), -1).all(axis=1)
    changes = int((~agrees).sum())
    expect(
        (~agrees).mean() <= _MAX_FLIPS,
        f"{what} changes when the world is rotated and shifted, at {changes} of {len(agrees)} moments",
        "use the ego frame (tasks.observations.View), distances and differences of headings",
    )


def are_same(left: Any, right: Any, tolerance: float) -> bool:
    """Return whether two trees have the same structure and shapes, and values within a tolerance or both NaN."""
    if jax.tree.structure(left) != jax.tree.structure(right):
        return False
    return all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    )
