"""Direct transcription: local optima of a discretised problem by sequential quadratic programming."""
