"""Numerical methods: integration with sensitivities, small linear systems, and continuation."""
