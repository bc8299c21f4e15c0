"""Traffic models: how agents that are not driven move.

``log`` contains log replay, ``reactive`` IDM traffic (:class:`IdmTraffic`), ``override`` given trajectories.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
