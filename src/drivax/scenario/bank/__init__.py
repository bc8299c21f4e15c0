"""Scenarios on the device: stacked arrays, and the map queries on them."""
