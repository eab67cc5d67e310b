"""Layouts of the built-in families."""
