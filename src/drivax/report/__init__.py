"""Reports of runs and scenario sets: pages, tables, comparisons, videos and pictures.

:mod:`drivax.table` renders tables; ``evaluation.result_tables`` fills those of evaluations; ``pages.report`` saves
them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
