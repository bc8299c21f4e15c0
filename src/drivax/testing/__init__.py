"""Free checks of a user's own terms: call one in a test; in one line it tells which rule is broken and how to mend it.

``check_reward``, ``check_metric``, ``check_feature``, ``check_traffic``, ``check_planner``, ``check_encoder`` and
``check_algorithm`` take the term itself or its dotted name. Our own terms pass them too.
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
