"""From a situation to step metrics, episode metrics and scores."""
