"""Evaluate planners, compare evaluations, and audit scenarios.

``runner`` evaluates, and ``episode_table`` writes ``episodes.csv``, ``summary.json`` and trajectories. ``comparison``
has the plan, runs the tests, and decides: on significance in ``MetricComparison.with_winner``, on a recommended planner
in ``decide``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
