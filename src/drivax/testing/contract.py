"""Rules of pure functions that all checks share, and their error messages."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.errors import DrivaxError

#: Tolerances: sums in another order; maps rotated in float32.
CLOSE, TURNED = 1e-4, 5e-3
#: Share of moments at which a threshold may flip in a rotated world.
_FLIPS = 0.05
_PYTHON = (
    jax.errors.TracerBoolConversionError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
)


class BrokenContract(DrivaxError, AssertionError):
    """A component breaks a rule; one line with the rule and the cure."""


def expect(condition: Any, problem: str, cure: str) -> None:
    """Raise unless a condition holds.

    Raises:
        BrokenContract: ``condition`` is false.
    """
    if not condition:
        raise BrokenContract(problem, cure=cure)


@contextlib.contextmanager
def _tracing_errors(what: str) -> Iterator[None]:
    """Turn JAX's tracing errors into one line."""
    try:
        yield
    except _PYTHON as error:
        raise BrokenContract(
            f"{what} cannot be compiled: Python needs the value of a traced array",
            cure="use jnp.where instead of if, and jnp instead of numpy, float() or int()",
        ) from error


def compiled(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a function under ``jit``, freshly traced, as numpy arrays.

    Raises:
        BrokenContract: The function cannot be compiled.
    """
    return program(what, function)(*arguments)


def program(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a jitted function with numpy results; calls raise :class:`BrokenContract` if it cannot be compiled."""
    run = jax.jit(lambda *values: function(*values))

    def call(*arguments: Any) -> Any:
        with _tracing_errors(what):
            return jax.device_get(run(*arguments))

    return call


def forms(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the shapes and types of a function's results.

    Raises:
        BrokenContract: The function cannot be compiled.
    """
    with _tracing_errors(what):
        return jax.eval_shape(function, *arguments)


class Program:
    """A function of one row, batched and compiled.

    Args:
        what: Name in messages.
        function: The function.
        in_axes: 0 for batched arguments, None for shared ones.
    """

    def __init__(
        self, what: str, function: Callable[..., Any], in_axes: tuple[int | None, ...] = (0,)
    ) -> None:
        self.what, self.function, self.in_axes = what, function, in_axes
        self._run = self._compiled()

    def _compiled(self) -> Callable[..., Any]:
        batched = jax.vmap(self.function, self.in_axes)
        return jax.jit(lambda *arguments: batched(*arguments))

    def __call__(self, *arguments: Any) -> Any:
        """Return the results for all rows as numpy arrays.

        Raises:
            BrokenContract: The function cannot be compiled.
        """
        with _tracing_errors(self.what):
            return jax.device_get(self._run(*arguments))

    def check_pure(self, *arguments: Any) -> Any:
        """Check that results do not depend on compilation, batching or repetition, and return them."""
        what, results = self.what, self(*arguments)
        expect(
            same(results, jax.device_get(self._compiled()(*arguments)), 0.0),
            f"{what} is not deterministic",
            "take randomness from a key, and keep no state between calls",
        )
        pairs = zip(arguments, self.in_axes, strict=True)
        row = [value if axis is None else jax.tree.map(lambda leaf: leaf[0], value) for value, axis in pairs]
        first = jax.tree.map(lambda leaf: leaf[0], results)
        expect(
            same(first, compiled(what, self.function, *row), CLOSE),
            f"{what} differs in a batch",
            "write it for one agent in one scenario; vmap adds the batch",
        )
        expect(
            same(first, jax.device_get(self.function(*row)), CLOSE),
            f"{what} differs when compiled",
            "let the result depend on the arguments only",
        )
        return results


def check_numbers(what: str, values: Any, reads: str = "a division, a root or a logarithm") -> None:
    """Check that all values are finite."""
    for leaf in jax.tree.leaves(values):
        broken = ~np.isfinite(leaf)
        if broken.any():
            rows = broken.reshape(len(leaf), -1).any(axis=1) if leaf.ndim else broken[None]
            raise BrokenContract(
                f"{what} is not finite at {int(rows.sum())} of {len(rows)} moments",
                cure=f"guard {reads} with jnp.where on its input",
            )


def check_same(what: str, result: Any, changed: Any, cause: str, cure: str) -> None:
    """Check that two results agree at all moments.

    Raises:
        BrokenContract: They differ; ``cause`` completes "changes when".
    """
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
    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        for a, b in pairs
    )


def check_scalar(what: str, value: Any) -> None:
    """Check that each row is one float32 number."""
    leaf = np.asarray(value)
    expect(
        leaf.ndim == 1 and leaf.dtype == jnp.float32,
        f"{what} gives {leaf.dtype}{list(leaf.shape[1:])} instead of one float32 number",
        "reduce it to a scalar, and convert booleans with .astype(jnp.float32)",
    )
