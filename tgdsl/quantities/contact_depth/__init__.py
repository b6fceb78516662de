"""Penetration depth of probes into objects, with contact normals and relative motion."""
