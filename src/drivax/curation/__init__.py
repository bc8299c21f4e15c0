"""Criticality scores for recorded scenarios."""
