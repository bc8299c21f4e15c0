"""Episode metrics: ``catalogue`` defines the metrics (``METRICS``), ``steps`` their step values (``STEP_VALUES``).

Collisions and time to collision are measured in ``simulator.contact``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
