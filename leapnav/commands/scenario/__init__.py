"""Commands on one scenario file."""
