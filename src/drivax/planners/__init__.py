"""Planners with one interface: expert, rule-based, network, and user functions.

``catalogue.PLANNERS`` has the built-in ones by name. :mod:`drivax.learning.policies` loads trained policies.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
