"""Checks for users' own components: call one in a test; the error names the broken rule and the cure.

``check_reward``, ``check_metric``, ``check_feature``, ``check_traffic``, ``check_planner``, ``check_encoder`` and
``check_algorithm`` take an object or its dotted name. The built-in components pass them too.
"""

from drivax.testing.algorithms import check_algorithm
from drivax.testing.contract import BrokenContract
from drivax.testing.encoders import check_encoder
from drivax.testing.observations import check_feature
from drivax.testing.planners import check_planner
from drivax.testing.terms import check_metric, check_reward
from drivax.testing.traffic import check_traffic

__all__ = [
    "BrokenContract",
    "check_algorithm",
    "check_encoder",
    "check_feature",
    "check_metric",
    "check_planner",
    "check_reward",
    "check_traffic",
]
