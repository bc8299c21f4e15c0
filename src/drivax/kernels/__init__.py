"""Optional native kernels for CPUs, with the results of the JAX functions that call them, up to rounding.

``library`` finds, registers and calls them; ``bindings`` has a function for each kernel. The sources are in ``native``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
