"""Reader of nuScenes tables and maps."""
