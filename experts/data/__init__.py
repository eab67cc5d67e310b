"""Scenario banks, demonstrations and rollouts made by the expert."""
