"""Field types of documents: quantities with units, regions, and the base of all models."""
