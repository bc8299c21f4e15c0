"""Random road networks of the built-in world: curves, lanes, rules, lights and families.

``families.junctions.set_lights`` assigns the phases of traffic lights; ``signals`` computes their colours over time.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
