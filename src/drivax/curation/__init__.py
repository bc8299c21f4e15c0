"""Criticality scores of logged scenarios, sampling weights, and the most critical subset of a set."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
