"""What every part of a document is made of: quantities with units, regions, and the base of all models."""
