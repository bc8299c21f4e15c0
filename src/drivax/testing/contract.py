"""Rules of pure functions, which all checks share, and their error messages."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from drivax.errors import DrivaxError
from drivax.plugins import find_named

#: Tolerances: sums in another order; maps rotated in float32.
CLOSE, TURNED = 1e-4, 5e-3
#: Share of moments at which a threshold may flip in a rotated world.
_FLIPS = 0.05
#: Changes of a world that must not change results, and cures; ``worlds`` has them for banks and frames in this order.
_VARIANTS = (
    ("the rows of absent agents change", "mask with frame.valid first"),
    ("empty slots are added", "mask with frame.valid, also before a mean"),
    ("the order of agents changes", "let no result depend on a slot: sort by distance, or reduce over all"),
)
_PYTHON = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
)


class BrokenContract(DrivaxError, AssertionError):
    """A component breaks a rule; the message names the rule and the cure."""


def expect(condition: Any, problem: str, cure: str) -> None:
    """Raise :class:`BrokenContract` unless a condition holds."""
    if not condition:
        raise BrokenContract(problem, cure=cure)


def instance(component: Any) -> Any:
    """Return a component, also from its class or a dotted name of either."""
    component = find_named(component) if isinstance(component, str) else component
    return component() if isinstance(component, type) else component


@contextlib.contextmanager
def _tracing_errors(what: str) -> Iterator[None]:
    """Turn JAX's tracing errors into one line."""
    try:
        yield
    except _PYTHON as error:
        problem = f"{what} cannot be compiled: Python needs the value of a traced array"
        cure = "use jnp.where instead of if, and jnp instead of numpy, float() or int()"
        raise BrokenContract(problem, cure=cure) from error


def form(leaf: Any) -> str:
    """Return type and shape of an array, as in ``float32[3, 2]``."""
    return f"{leaf.dtype}{list(leaf.shape)}"


def layout(tree: Any) -> Any:
    """Return structure, types and shapes of a tree, to compare."""
    return jax.tree.structure(tree), [form(leaf) for leaf in jax.tree.leaves(tree)]


def program(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a freshly jitted function with numpy results; it raises :class:`BrokenContract` if tracing fails."""
    run = jax.jit(lambda *values: function(*values))

    def call(*arguments: Any) -> Any:
        with _tracing_errors(what):
            return jax.device_get(run(*arguments))

    return call


def forms(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the shapes and types of a function's results; raise :class:`BrokenContract` if tracing fails."""
    with _tracing_errors(what):
        return jax.eval_shape(function, *arguments)


class Program:
    """A function of one row, named ``what`` in messages, batched (``in_axes`` of ``jax.vmap``) and compiled."""

    def __init__(
        self, what: str, function: Callable[..., Any], in_axes: tuple[int | None, ...] = (0,)
    ) -> None:
        self.what, self.function, self.in_axes = what, function, in_axes
        self._batched = jax.vmap(function, in_axes)
        self._run = program(what, self._batched)

    def __call__(self, *arguments: Any) -> Any:
        """Return the results for all rows as numpy arrays."""
        return self._run(*arguments)

    def check_pure(self, *arguments: Any) -> Any:
        """Check that results do not depend on compilation, batching or repetition, and return them."""
        what, results = self.what, self(*arguments)
        repeated = same(results, program(what, self._batched)(*arguments), 0.0)
        cure = "take randomness from a key, and keep no state between calls"
        expect(repeated, f"{what} is not deterministic", cure)
        pairs = zip(arguments, self.in_axes, strict=True)
        row = [value if axis is None else jax.tree.map(lambda leaf: leaf[0], value) for value, axis in pairs]
        first = jax.tree.map(lambda leaf: leaf[0], results)
        single = same(first, program(what, self.function)(*row), CLOSE)
        cure = "write it for one agent in one scenario; vmap adds the batch"
        expect(single, f"{what} differs in a batch", cure)
        eager = same(first, jax.device_get(self.function(*row)), CLOSE)
        expect(eager, f"{what} differs when compiled", "let the result depend on the arguments only")
        return results


def check_numbers(what: str, values: Any, reads: str = "a division, a root or a logarithm") -> None:
    """Check that all values are finite."""
    for leaf in jax.tree.leaves(values):
        broken = ~np.isfinite(leaf)
        if broken.any():
            rows = broken.reshape(len(leaf), -1).any(axis=1) if leaf.ndim else broken[None]
            problem = f"{what} is not finite at {int(rows.sum())} of {len(rows)} moments"
            raise BrokenContract(problem, cure=f"guard {reads} with jnp.where on its input")


def check_variants(
    what: str, results: Any, variants: Sequence[Any], run: Callable[[Callable[..., Any]], Any]
) -> None:
    """Check that ``run`` gives the same results in ``worlds.BANK_VARIANTS`` or ``worlds.FRAME_VARIANTS``."""
    for variant, (cause, cure) in zip(variants, _VARIANTS, strict=True):
        check_same(what, results, run(variant), cause, cure)


def check_same(what: str, result: Any, changed: Any, cause: str, cure: str) -> None:
    """Check that two results agree at all moments; ``cause`` completes "changes when"."""
    expect(same(result, changed, CLOSE), f"{what} changes when {cause}", cure)


def check_turned(what: str, result: Any, turned: Any) -> None:
    """Check that results agree in a rotated and shifted world, except for a few thresholds."""
    close = np.ones(len(jax.tree.leaves(result)[0]), bool)
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(turned), strict=True):
        near = np.isclose(a, b, rtol=TURNED, atol=TURNED)
        close &= near.reshape(len(close), -1).all(axis=1)
    expect(
        (~close).mean() <= _FLIPS,
        f"{what} changes when the world is rotated and shifted, at {int((~close).sum())} of {len(close)} moments",
        "use the ego frame (tasks.observations.View), distances and differences of headings",
    )


def same(left: Any, right: Any, tolerance: float) -> bool:
    """Whether two trees have equal structure and shapes, and values within a tolerance."""
    if jax.tree.structure(left) != jax.tree.structure(right):
        return False
    return all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    )
