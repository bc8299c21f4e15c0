"""Self-contained HTML pages: ``report`` of runs, ``comparison``, ``inspection`` and player (``viewer``) of sets."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
