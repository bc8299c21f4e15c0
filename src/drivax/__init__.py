"""Train, curate and judge driving planners on recorded traffic, in one JAX program."""
