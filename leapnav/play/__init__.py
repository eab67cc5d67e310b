"""The interactive page of `leapnav play`: a scenario to edit, and its optimum."""
