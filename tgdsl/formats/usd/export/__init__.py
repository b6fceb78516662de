"""MJCF and URDF models, exported as USD stages."""
