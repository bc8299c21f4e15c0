"""What every check asks: the rules that any pure function of the graph keeps, and how a broken one is told."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.errors import DrivaxError

#: Of what is compared: sums in another order, and maps that were turned in float32.
CLOSE, TURNED = 1e-4, 5e-3
#: A threshold may fall on the other side in a turned world; more than this share of the moments means another thing.
_FLIPS = 0.05
_PYTHON = (
    jax.errors.TracerBoolConversionError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
)


class BrokenContract(DrivaxError, AssertionError):
    """A term of the user's own does not keep to a rule; one line that says which and what to do."""


def expect(kept: Any, problem: str, cure: str) -> None:
    """Refuses what does not keep to a rule.

    Raises:
        BrokenContract: ``kept`` is false.
    """
    if not kept:
        raise BrokenContract(problem, cure=cure)


@contextlib.contextmanager
def _told(what: str) -> Iterator[None]:
    """Tells in one line what JAX says of code that asks for the value of an array."""
    try:
        yield
    except _PYTHON as error:
        raise BrokenContract(
            f"{what} cannot be compiled: it asks Python for the value of an array",
            cure="use jnp.where instead of if, and jnp instead of numpy, float() or int()",
        ) from error


def compiled(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function under ``jit``, freshly traced, as numpy arrays.

    Raises:
        BrokenContract: It cannot be compiled.
    """
    return program(what, function)(*arguments)


def program(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function under ``jit``, traced once for all arguments of one form, that gives numpy arrays.

    It raises :class:`BrokenContract` where the function cannot be compiled.
    """
    run = jax.jit(lambda *values: function(*values))

    def call(*arguments: Any) -> Any:
        with _told(what):
            return jax.device_get(run(*arguments))

    return call


def forms(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Shapes and types of what a function gives.

    Raises:
        BrokenContract: It cannot be compiled.
    """
    with _told(what):
        return jax.eval_shape(function, *arguments)


class Program:
    """A function of one row, batched; compiled once for all arguments of one form.

    Args:
        what: What messages call it.
        function: The function.
        in_axes: 0 for arguments with rows, None for those that all rows share.
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
        """The results for all rows, as numpy arrays.

        Raises:
            BrokenContract: It cannot be compiled.
        """
        with _told(self.what):
            return jax.device_get(self._run(*arguments))

    def check_pure(self, *arguments: Any) -> Any:
        """Whether it gives the same compiled or not, batched or not, and every time; and its results for all rows."""
        what, results = self.what, self(*arguments)
        expect(
            same(results, jax.device_get(self._compiled()(*arguments)), 0.0),
            f"{what} gives another result every time",
            "take randomness from a key, and keep nothing between calls",
        )
        pairs = zip(arguments, self.in_axes, strict=True)
        row = [one if axis is None else jax.tree.map(lambda leaf: leaf[0], one) for one, axis in pairs]
        first = jax.tree.map(lambda leaf: leaf[0], results)
        expect(
            same(first, compiled(what, self.function, *row), CLOSE),
            f"{what} gives another result in a batch than alone",
            "write it for one agent in one scenario; batches are made by vmap",
        )
        expect(
            same(first, jax.device_get(self.function(*row)), CLOSE),
            f"{what} gives another result when it is compiled",
            "let the result depend on the arguments only",
        )
        return results


def check_numbers(what: str, values: Any, reads: str = "a division, a root or a logarithm") -> None:
    """Whether everything is finite."""
    for leaf in jax.tree.leaves(values):
        broken = ~np.isfinite(leaf)
        if broken.any():
            rows = broken.reshape(len(leaf), -1).any(axis=1) if leaf.ndim else broken[None]
            raise BrokenContract(
                f"{what} is not finite at {int(rows.sum())} of {len(rows)} moments",
                cure=f"guard {reads} with jnp.where on its input",
            )


def check_same(what: str, one: Any, other: Any, cause: str, cure: str) -> None:
    """Whether two results agree at every moment.

    Raises:
        BrokenContract: They do not; ``cause`` completes "changes when".
    """
    expect(same(one, other, CLOSE), f"{what} changes when {cause}", cure)


def check_turned(what: str, one: Any, other: Any) -> None:
    """Whether the results of a turned world agree with those of the world, but for a few thresholds."""
    close = np.ones(len(jax.tree.leaves(one)[0]), bool)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        near = np.isclose(a, b, rtol=TURNED, atol=TURNED)
        close &= near.reshape(len(close), -1).all(axis=1)
    expect(
        (~close).mean() <= _FLIPS,
        f"{what} changes when the world is turned and shifted, at {int((~close).sum())} of {len(close)} moments",
        "use the ego frame (tasks.observations.View), distances and differences of headings",
    )


def same(one: Any, other: Any, tolerance: float) -> bool:
    """Whether two trees hold the same values: equal structure, shapes, and values within a tolerance."""
    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        for a, b in pairs
    )


def check_scalar(what: str, value: Any) -> None:
    """Whether every row gives one float32 number."""
    leaf = np.asarray(value)
    expect(
        leaf.ndim == 1 and leaf.dtype == jnp.float32,
        f"{what} gives {leaf.dtype}{list(leaf.shape[1:])} instead of one float32 number",
        "reduce it to a scalar, and turn booleans into numbers with .astype(jnp.float32)",
    )
