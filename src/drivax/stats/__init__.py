"""Statistics of episodes in clusters: intervals, significance tests, effect sizes, seeds and rankings.

``intervals`` resamples clusters (recordings, labelled by ``clusters``), and ``significance`` tests differences.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
