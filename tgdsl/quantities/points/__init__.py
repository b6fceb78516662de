"""Points sampled on objects, and how deep they are in links' own surfaces."""
