"""Imitation of the expert: datasets, behaviour cloning, DAgger, warm starts and demonstration replay."""
