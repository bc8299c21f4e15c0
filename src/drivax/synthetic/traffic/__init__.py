"""Road users of the procedural world: their roles, and the simulation of their motion."""
