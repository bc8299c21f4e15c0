"""Shared by the tests of native kernels: what they need, and how they run once for each instruction set."""

import os
import shutil
import subprocess
import sys
from functools import cache

import jax
import numpy as np
import pytest

from drivax import kernels

needs_kernels = pytest.mark.skipif(not kernels.in_use(), reason=f"no native kernels: {kernels.state()}")
COMPILER = os.environ.get("CXX", "c++")
needs_compiler = pytest.mark.skipif(shutil.which(COMPILER) is None, reason=f"no C++ compiler {COMPILER}")
TARGETS = ("sse4.2", "avx2")


def run_on_target(target, test_file):
    """Run a file's fast tests for an older instruction set, in a process of its own."""
    run_tests(test_file, DRIVAX_NATIVE=target)


def run_tests(path, select="not slow", **variables):
    """Run tests of a file or folder in a process of its own, by default fast ones, with variables of the environment.

    Tests that run others are left out.
    """
    options = (
        "-q",
        "-rs",
        "-x",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        "-m",
        select,
        "-k",
        "not older_instruction_sets and not sanitizers",
    )
    command = [sys.executable, "-m", "pytest", *options, str(path)]
    environment = os.environ | variables
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-2000:]
    assert "passed" in result.stdout and ": no native kernels" not in result.stdout, result.stdout[-2000:]


def assert_close(actual, expected, tolerance=1e-5):
    """Compare floats to the scale of the largest; NaN and infinity must be the same."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    finite = np.isfinite(expected)
    scale = max(np.abs(expected[finite]).max(initial=0.0), 1e-6)
    np.testing.assert_array_equal(actual[~finite], expected[~finite])
    np.testing.assert_allclose(actual[finite] / scale, expected[finite] / scale, rtol=0, atol=tolerance)


def widen(leaf):
    leaf = np.asarray(leaf)
    return leaf.astype(np.float64) if leaf.dtype == np.float32 else leaf


def equal_samples(actual, expected):
    """Mask of the samples of which all leaves are equal, floats up to 1e-5."""
    same = True
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        a, b = (np.asarray(leaf).reshape(len(leaf), -1) for leaf in (a, b))
        is_float = b.dtype.kind == "f"
        near = np.isclose(a, b, rtol=1e-5, atol=1e-5, equal_nan=True) if is_float else a == b
        same &= near.all(axis=1)
    return same


def assert_same(function, axes, arguments, rare=0.01):
    """Kernels give what XLA gives, but for samples on a threshold, which rounding moves to either side.

    These are found in float64: when their numbers change by the rounding of float32, the result becomes that of the
    kernel, too. At most the share ``rare`` of the samples may be such ones.
    """
    batch = jitted(function, axes)
    actual = jax.device_get(batch(*arguments))
    with kernels.without_kernels():
        expected = jax.device_get(batch(*arguments))
    differs = np.flatnonzero(~equal_samples(actual, expected))
    assert len(differs) <= rare * len(jax.tree.leaves(actual)[0])
    for sample in differs:
        result = jax.tree.map(lambda leaf, i=sample: np.stack([leaf[i]] * 100), actual)
        nearby = jax.tree.map(widen, results_nearby(function, axes, arguments, sample))
        assert equal_samples(result, nearby).any(), sample
    return expected


@cache
def jitted(function, axes):
    return jax.jit(jax.vmap(function, axes))


def results_nearby(function, axes, arguments, sample, count=100):
    """Results in float64 of a sample whose numbers change by the rounding of float32."""
    rng = np.random.default_rng(0)

    def spread(leaf):
        values = np.broadcast_to(widen(leaf)[sample], (count, *np.shape(leaf)[1:]))
        if values.dtype != np.float64:
            return values
        noise = rng.uniform(-1, 1, values.shape) * np.maximum(np.abs(values), 1.0)
        return values + 2e-7 * noise * rng.choice([0.1, 1.0, 8.0], (count,) + (1,) * (values.ndim - 1))

    with jax.enable_x64(True):
        spreads = [
            jax.tree.map(spread if axis == 0 else widen, argument)
            for argument, axis in zip(arguments, axes, strict=True)
        ]
        return jax.device_get(jitted(function, axes)(*spreads))
