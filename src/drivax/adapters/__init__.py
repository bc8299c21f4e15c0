"""Faces for other ecosystems (Gymnasium)."""
