"""Evaluate planners, compare evaluations, and audit scenarios.

``runner`` evaluates, and ``episode_table`` writes ``episodes.csv``, ``summary.json`` and trajectories. ``comparison``
runs the tests; ``plan`` decides on significance (``MetricComparison.with_winner``), then ``decide`` recommends a
planner.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
