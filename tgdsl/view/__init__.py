"""Pictures and tables of touch."""
