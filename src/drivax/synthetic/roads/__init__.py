"""Road networks: curves, lanes, signals and the families that draw them."""
