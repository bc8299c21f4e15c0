"""Intervals, tests, clusters and effect sizes; knows numbers, not driving."""
