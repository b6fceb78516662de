"""An XHand1 that is not there: a hand behind a pseudo-terminal."""
