"""Shared by the tests of native kernels: they skip without the library, and run once for each instruction set."""

import os
import subprocess
import sys

import numpy as np
import pytest

from drivax import kernels

needs_kernels = pytest.mark.skipif(not kernels.in_use(), reason=f"no native kernels: {kernels.state()}")
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
    # Without the library they would be skipped.
    assert "passed" in result.stdout and "skipped" not in result.stdout


def assert_close(actual, expected, tolerance=1e-5):
    """Compare floats to the scale of the largest; NaN and infinity must be the same."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    finite = np.isfinite(expected)
    scale = max(np.abs(expected[finite]).max(initial=0.0), 1e-6)
    np.testing.assert_array_equal(actual[~finite], expected[~finite])
    np.testing.assert_allclose(actual[finite] / scale, expected[finite] / scale, rtol=0, atol=tolerance)
