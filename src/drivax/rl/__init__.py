"""Equations of reinforcement learning: arrays in, arrays out.

``equations`` has advantages and returns, TD targets, and the terms of losses, among them PPO's clipped surrogate. The
modules of :mod:`drivax.learning.algorithms` add these terms up to the loss of an algorithm. ``off_policy_evaluation``
estimates a policy's return from episodes of others.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
