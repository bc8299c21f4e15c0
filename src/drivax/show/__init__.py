"""Pictures, animations and the HTML report."""
