"""Readers against damaged files: any bytes end in a clear error or in a sound scenario."""
