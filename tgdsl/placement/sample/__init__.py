"""Taxels on a link's surface: grids, even samples, points."""
