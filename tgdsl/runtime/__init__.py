"""Sources of scene states: simulators, hardware and logs."""
