"""Tags, selections and splits of scenario sets.

``tags`` computes the tags of a scenario, ``selection`` filters a set by them, and ``splits`` divides it by recording.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
