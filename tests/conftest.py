"""Environment of every test: few threads, a shared compilation cache, and type checks of the whole package.

Run time checks: jaxtyping's import hook puts beartype on every annotated function of drivax, so a wrong shape
or type fails the test that caused it. ``DRIVAX_UNCHECKED=1`` leaves the hook out (for timing).

Most programs run once on tiny arrays, and compiling them takes most of the time; with little optimisation it takes half
as long. ``DRIVAX_OPTIMISED=1`` compiles as users do; ``make test-all`` sets it.
"""

from __future__ import annotations

import gc
import os
import sys
import types
from pathlib import Path
from typing import Any, Self

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent

# Before anything imports JAX or a BLAS: two xdist workers must not fight over the cores, and compiled
# programs are kept between runs. Subprocesses that tests start inherit both.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
_FLAGS = ["--xla_cpu_multi_thread_eigen=false"]
if not os.environ.get("DRIVAX_OPTIMISED"):
    _FLAGS += [
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_backend_optimization_level=0",
        "--xla_llvm_disable_expensive_passes=true",
        # Parts of a program that are compiled in parallel; a worker has one core.
        "--xla_cpu_parallel_codegen_split_count=1",
    ]
os.environ.setdefault("XLA_FLAGS", " ".join(_FLAGS))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("MPLBACKEND", "agg")


def _install_checks() -> None:
    import beartype
    import jaxtyping
    import numpy as np

    # Spellings that beartype refuses: an array of anything, and Self outside a class that it decorates.
    spellings = beartype.FrozenDict({np.ndarray[Any, Any]: np.ndarray, Self: Any})
    checks = types.ModuleType("drivax_checks")
    checks.checked = beartype.beartype(
        conf=beartype.BeartypeConf(hint_overrides=spellings, is_pep484_tower=True)
    )
    sys.modules[checks.__name__] = checks
    jaxtyping.install_import_hook("drivax", "drivax_checks.checked")


if not os.environ.get("DRIVAX_UNCHECKED"):
    _install_checks()

import hypothesis  # noqa: E402  (after the environment is set)

hypothesis.settings.register_profile(
    "dev", deadline=None, max_examples=25, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.register_profile("ci", hypothesis.settings.get_profile("dev"), derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "dev")


def pytest_collection_finish() -> None:
    """Collect garbage seldom: tracing makes many objects that are no garbage, and imported ones stay for ever."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 10, 10)


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings next to the checkout; their licences keep them out of it."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real recordings at ../shared/data")
    return folder
