"""The page of `leapnav play`: a scenario to drag about, and its optimum."""
