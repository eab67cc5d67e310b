"""Batched simulation of independent robots: motion, contacts, sensing, observations, rendering."""
