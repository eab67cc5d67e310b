"""Commands for the worlds of other benchmarks."""
