"""Train and evaluate driving planners on recorded traffic, and curate their training data, in one JAX program.

``generate``, ``train``, ``evaluate``, ``write_report`` and other functions do what the commands do. Names are imported
on first use: ``import drivax`` is fast, and worker processes that convert data never load JAX.
"""

from __future__ import annotations

import os
from importlib import metadata

import lazy_loader

#: The concurrency scheduler of jaxlib 0.10's CPU client can hang programs that train several seeds (see
#: ``learning.program.widen_pool``). XLA aborts on unknown flags, so the flag depends on the version.
_XLA_FLAG, _XLA_SERIES = "--xla_cpu_enable_concurrency_optimized_scheduler", "0.10."


def _disable_concurrency_scheduler() -> None:
    """Disable the scheduler before JAX starts its backend, unless the user has set the flag."""
    flags = os.environ.get("XLA_FLAGS", "")
    try:
        has_flag = metadata.version("jaxlib").startswith(_XLA_SERIES)
    except metadata.PackageNotFoundError:
        return
    if has_flag and _XLA_FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_XLA_FLAG}=false".strip()


_disable_concurrency_scheduler()

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
