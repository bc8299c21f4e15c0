"""Random road networks of the procedural world: curves, lanes, rules, lights and families."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
