"""The pool of threads that XLA runs a program on."""

from __future__ import annotations

import os

#: With so many threads there is always one that does not wait for another.
_THREADS = 8


def widen_pool() -> None:
    """Gives XLA's pool on the CPU eight threads where cores are fewer, unless ``NPROC`` says otherwise.

    Parts of a program wait for others in the pool, and with two threads programs that train several agents side by
    side hang for ever once both wait (jaxlib 0.10.2). Other programs are slower with more threads than cores, so only
    such a training asks for it. Without effect once JAX has started.
    """
    if (os.cpu_count() or 1) < _THREADS:
        os.environ.setdefault("NPROC", str(_THREADS))
