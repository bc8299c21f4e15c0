"""Reinforcement-learning equations: arrays in, arrays out."""
