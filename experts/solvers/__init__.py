"""Solvers of the boundary value problem of the minimum principle, one file per method."""
