"""The procedural traffic world."""
