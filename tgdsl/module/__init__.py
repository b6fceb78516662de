"""The compiled module: scene states in, readings and observations out."""
