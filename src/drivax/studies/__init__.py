"""The experiments that the documentation quotes, and the demo."""
