"""Angles and oriented boxes, for NumPy and JAX arrays, and polylines, for NumPy arrays."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
