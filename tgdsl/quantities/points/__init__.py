"""Points sampled on objects, and their signed distances to the links' surfaces."""
