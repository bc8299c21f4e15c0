"""Reader of nuPlan logs and maps."""
