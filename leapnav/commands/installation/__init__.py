"""Commands about the installation: compilation, shell completion, self-test."""
