"""Scenarios and episodes drawn as pictures, videos and player data."""
