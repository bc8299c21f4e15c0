"""Closed-loop runner, statistics, tables and the audit."""
