"""Parts that all simulators of a module's scene share."""
