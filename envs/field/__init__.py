"""The packed field of a scenario: obstacles, walls and proximity cost as one array, and the kernels that read it."""
