"""Criticality scores of logged scenarios, sampling weights, and the most critical subset of a set.

``methods`` registers the methods and applies them to a set: ``kinematic``, ``rarity``, ``novelty``, ``query`` and
``failures`` compute components of every step of the logs (read by ``logged``), and ``ensemble`` trains policies, whose
disagreement ``methods`` scores.
``scores`` holds the table of scores and writes the most critical scenarios; ``weights`` converts a table to sampling
weights.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
