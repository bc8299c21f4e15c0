"""One training loop; per algorithm a configuration and an update."""
