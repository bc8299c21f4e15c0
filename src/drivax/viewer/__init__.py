"""A scenario player in the browser."""
