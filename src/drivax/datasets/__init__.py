"""One reader per public format, conversion to scenario sets, and export to other formats.

A new reader is registered in ``formats.READERS``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
