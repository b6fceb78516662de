"""Objects that differ between environments: variants, sizes, masses and frictions."""
