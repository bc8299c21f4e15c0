"""Drivers with one interface: expert, constant velocity, IDM, a network."""
