"""The expert that drives ego: candidate paths, speed search, smoothing and checks.

``plan`` chooses the path and its speeds (``speed_search``), which ``smoothing`` makes comfortable; ``driver`` drives.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
