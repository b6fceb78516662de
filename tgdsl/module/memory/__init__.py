"""What a module carries from one call to the next: buffers of sensors, its clock, and windows over the last readings."""
