"""Plots of scenarios, extremals and banks with Matplotlib."""
