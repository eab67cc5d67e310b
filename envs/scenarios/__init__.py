"""Scenarios (navigation tasks), random families of scenarios, maps, and scenario banks."""
