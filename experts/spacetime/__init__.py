"""Search among moving obstacles: paths over position and time."""
