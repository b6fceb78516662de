"""The real XHand1: its protocol on the wire, a driver, an emulator of the hand, and calibration."""
