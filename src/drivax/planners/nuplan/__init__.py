"""Planners with the interface of nuPlan's devkit, which need not be installed."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
