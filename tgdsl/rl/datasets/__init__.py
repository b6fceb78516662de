"""Datasets of episodes with touch: from simulations, emulated and real hands, as LeRobot, Zarr or MCAP files."""
