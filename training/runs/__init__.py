"""Training runs: run directories, checkpoints and one module per kind of algorithm."""
