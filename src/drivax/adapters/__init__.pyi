from .gym import TASKS as TASKS
from .gym import DrivingEnv as DrivingEnv
from .gym import VectorDrivingEnv as VectorDrivingEnv
from .gym import make as make
