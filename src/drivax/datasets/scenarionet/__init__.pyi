from .reader import ScenarioNet as ScenarioNet
