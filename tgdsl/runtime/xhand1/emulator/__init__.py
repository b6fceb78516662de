"""An emulated XHand1 behind a pseudo-terminal."""
