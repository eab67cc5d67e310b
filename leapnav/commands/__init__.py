"""The commands of `leapnav`, one module per command."""
