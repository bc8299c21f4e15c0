"""Readers of the Waymo Open Motion Dataset and of ScenarioMax.

The entry is ``scenario_reader.WomdScenario`` for protos, ``example_reader`` for tf.Examples and ScenarioMax.
"""
