"""Episode metrics: a metric is an entry of ``METRICS`` (``catalogue``), a quantity of a step one of ``STEP_VALUES``."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
