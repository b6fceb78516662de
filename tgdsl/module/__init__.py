"""The compiled sensor: tensors in, tensors out."""
