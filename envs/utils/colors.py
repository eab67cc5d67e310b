"""Colours with one meaning everywhere: in plots, rendered frames, reports and the page of `leapnav play`.

They also differ in lightness, for readers with a colour vision deficiency.
"""

START, GOAL = "#1a1a1a", "#22804f"
OPTIMUM = "#d9730d"
POLICY, FAILURE = "#2662ab", "#c0392b"  # paths of successful and of unsuccessful episodes
ALTERNATIVES = ("#7a5195", "#cc79a7", "#56b4e9", "#8a8a8a")  # other local optima, in order of cost
SWEEP = "#00857c"  # iterates of a solver
OBSTACLE, EDGE, WALL = "#c3c8d1", "#7a8190", "#3c4048"
CURVES = (POLICY, "#e08a00", GOAL, "#cc79a7", "#56b4e9", START)  # components of a vector, rows of a table
