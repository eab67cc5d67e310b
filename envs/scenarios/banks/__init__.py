"""The included scenario banks, and checks of what a bank contains."""
