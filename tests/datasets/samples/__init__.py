"""Tiny valid samples of every format, written without the code under test."""
