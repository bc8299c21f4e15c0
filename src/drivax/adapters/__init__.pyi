from .gym import TASKS as TASKS
from .gym import DrivingEnv as DrivingEnv
from .gym import VectorDrivingEnv as VectorDrivingEnv
from .gym import make as make
from .minari import read_minari as read_minari
from .minari import write_minari as write_minari
