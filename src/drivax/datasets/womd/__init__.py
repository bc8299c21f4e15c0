"""Readers of the Waymo Open Motion Dataset and of ScenarioMax.

``scenario_reader`` reads Scenario protos, ``example_reader`` tf.Examples of both.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
