"""Training environments for Stable-Baselines3: the vector environment and its wrappers."""
