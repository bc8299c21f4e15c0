"""Equations of reinforcement learning: arrays in, arrays out.

``equations`` has advantages and returns, TD targets, the terms of losses, among them PPO's clipped surrogate, and
estimators of a policy's return from episodes of others. The modules of :mod:`drivax.learning.algorithms` add the terms
up to the loss of an algorithm.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
