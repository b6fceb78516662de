"""Vectors as planes, primitives, the contact query, and triangle surfaces."""
