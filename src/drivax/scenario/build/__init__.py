"""Steps from a recording to a scenario: tracks, lane graph, routes, map segments and grid.

``assemble`` runs them. ``lane_paths.LaneSearch`` searches for routes; ``routes``, which also has the published search,
selects and samples paths.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
