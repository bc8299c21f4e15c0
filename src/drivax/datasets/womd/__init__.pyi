from .example_reader import ScenarioMax as ScenarioMax
from .example_reader import WomdExample as WomdExample
from .scenario_reader import WomdScenario as WomdScenario
