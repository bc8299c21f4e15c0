"""One module per algorithm: its configuration, state and update."""
