from .contract import BrokenContract as BrokenContract
from .learning import check_algorithm as check_algorithm
from .learning import check_encoder as check_encoder
from .simulation import check_planner as check_planner
from .simulation import check_traffic as check_traffic
from .terms import check_feature as check_feature
from .terms import check_metric as check_metric
from .terms import check_reward as check_reward
