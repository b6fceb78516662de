"""The XHand1: serial protocol, driver, emulator, calibration."""
