"""Reset and step as pure functions of a bank, a state and an action."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
