"""Readers of the Waymo Open Motion Dataset and of ScenarioMax.

``scenario_reader`` reads Scenario protos, ``example_reader`` tf.Examples of both.
"""
