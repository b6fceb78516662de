"""Triangle surfaces on NumPy: rays, solids, samples, regions."""
