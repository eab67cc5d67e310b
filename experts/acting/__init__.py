"""Optimal feedback: the expert policy and the re-solution from any state."""
