"""Pictures of scenarios and episodes: stills, videos, observations and data of the player."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
