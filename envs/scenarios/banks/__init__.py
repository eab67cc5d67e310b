"""Banks of scenarios included in leapnav (data)."""
