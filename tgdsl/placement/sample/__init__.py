"""Sampling of taxels on a link's surface: grids, Poisson disks, given points."""
