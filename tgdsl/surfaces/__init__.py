"""Triangle surfaces in NumPy: rays, solids, quadrature, regions."""
