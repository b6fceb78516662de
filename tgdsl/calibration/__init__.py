"""Parameters of sensors, fitted to recordings, and the calibration of a real hand."""
