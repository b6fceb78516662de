"""A pad whose edge is clamped: its surface as one sheet, unrolled to the plane, meshed, and solved by finite elements."""
