"""The built-in traffic world: procedural roads, traffic and events.

``world`` draws a scenario with the roads and traffic of one of the ``domains``; ``generate`` writes scenario sets, and
defines the splits of the benchmark.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
