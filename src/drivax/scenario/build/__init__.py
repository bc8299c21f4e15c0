"""From a recording to a scenario: lanes, routes, the segment grid and the checks on the way."""
