"""Policies: networks and their files, and baselines."""
