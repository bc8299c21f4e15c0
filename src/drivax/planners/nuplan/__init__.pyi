from .interface import EgoState as EgoState
from .interface import PlannerInitialization as PlannerInitialization
from .interface import PlannerInput as PlannerInput
from .map import MapApi as MapApi
from .planner import NuplanPlanner as NuplanPlanner
