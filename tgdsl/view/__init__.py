"""Pictures and tables of readings."""
