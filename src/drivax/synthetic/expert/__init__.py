"""The expert that drives ego: candidate paths, speed plans and checks.

``plan`` chooses the path and its speeds, which ``speed_plan`` searches and smooths; ``driver`` drives.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
