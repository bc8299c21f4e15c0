"""Run folders, metric sinks and checkpoints."""
