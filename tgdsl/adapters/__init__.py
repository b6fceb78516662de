"""Touch in other people's simulators: a file each, which imports the simulator that it is for."""
