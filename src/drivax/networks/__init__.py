"""Encoders, heads and distributions; knows arrays, not driving."""
