"""Vectors as component planes, signed distance of primitives, distance fields, and nearest-triangle queries."""
