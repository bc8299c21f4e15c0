"""Readers of Argoverse 2."""
