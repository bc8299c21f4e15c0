"""Steps from a recording to a scenario: tracks, lane graph, routes, map segments and grid.

``lane_paths`` searches paths in the lane graph; ``routes`` selects and samples those of ego.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
