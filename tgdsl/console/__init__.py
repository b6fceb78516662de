"""Console output: tables, and progress messages of long work."""
