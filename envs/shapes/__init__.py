"""Obstacle shapes and the obstacle field of a scenario: packing, clearance, and the proximity cost (kernels)."""
