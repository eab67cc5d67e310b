"""Global search for the optimum of a scenario: candidate paths and their local optima."""
