from .brake import BrakeConfig as BrakeConfig
from .brake import EmergencyBrake as EmergencyBrake
from .planner import PdmConfig as PdmConfig
from .planner import PdmPlanner as PdmPlanner
from .scoring import ScoringConfig as ScoringConfig
from .tracking import TrackingConfig as TrackingConfig
