"""Encoders, action distributions, and the policies, values and critics made of them (flax nnx).

``encoders.NormalisedEncoder`` normalises observations by statistics, which only offline algorithms set.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
