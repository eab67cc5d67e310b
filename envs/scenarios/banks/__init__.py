"""Banks of scenarios that ship with leapnav (data)."""
