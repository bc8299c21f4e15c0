"""Angles, oriented boxes and polylines: maths that knows no traffic. Works on numpy and JAX arrays alike."""
