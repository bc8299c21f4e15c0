"""Driving tasks: action spaces, observations, rewards and termination.

``observations`` scales features by constants; ``drivax.networks.encoders`` normalises them by statistics.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
