from .motion import ArgoverseMotion as ArgoverseMotion
from .sensor import ArgoverseSensor as ArgoverseSensor
