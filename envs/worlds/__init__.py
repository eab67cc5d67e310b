"""Scenarios from the worlds of other benchmarks, read from the user's own download."""
