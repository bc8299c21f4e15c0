"""One reader per public format, and conversion to scenario sets."""
