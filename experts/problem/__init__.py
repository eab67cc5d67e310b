"""Optimal control problems, extremals and certificates."""
