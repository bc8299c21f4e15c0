"""Reader of ScenarioNet pickles."""
