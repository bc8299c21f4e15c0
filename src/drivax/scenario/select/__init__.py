"""Which scenarios of a set: tags, filters and splits."""
