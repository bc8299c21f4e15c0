"""Readers of the Waymo Open Motion Dataset and of ScenarioMax."""
