"""Driving tasks: action spaces, observations, rewards and termination.

``actions`` has the action spaces with their bounds and actuator rates, ``rewards`` the terms. ``features`` names the
columns of observation groups; ``observations`` fills them and scales them by constants, ``drivax.networks.encoders``
normalises them by statistics.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
