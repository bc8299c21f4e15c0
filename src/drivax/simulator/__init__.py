"""Ego dynamics, traffic, frames, situations, reset and step."""
