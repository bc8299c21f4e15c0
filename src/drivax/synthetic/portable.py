"""The same numbers on any processor.

NumPy takes other routines where a processor has newer instructions, and OpenBLAS another kernel for every processor;
their last bits differ. Traffic that reacts to itself makes a nanometre of that, and a nanometre flips a bit of float32
in one of a thousand scenarios. Both can be told to do as on the oldest processor, before they are imported.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager

#: What NumPy was built for beyond the oldest processor, and what of it this one has.
_umath = importlib.import_module("numpy._core._multiarray_umath")
#: Tells NumPy which of them to leave alone.
_FEATURES = "NPY_DISABLE_CPU_FEATURES"


@contextmanager
def portable_workers() -> Iterator[None]:
    """Processes that are started within compute alike on any x86-64 processor; this one is as it was."""
    # What this process was told to leave alone it does not have any more, but they would.
    told = os.environ.get(_FEATURES, "").split()
    newer = [name for name in _umath.__cpu_dispatch__ if _umath.__cpu_features__[name] or name in told]
    found = {_FEATURES: " ".join(newer), "OPENBLAS_CORETYPE": "Prescott"}
    before = {name: os.environ.get(name) for name in found}
    os.environ.update(found)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
