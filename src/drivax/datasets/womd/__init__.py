"""Readers of the Waymo Open Motion Dataset."""
