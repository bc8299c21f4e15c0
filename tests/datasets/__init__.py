"""Tests of the readers and of conversion."""
