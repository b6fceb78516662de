"""Contact mechanics: half-spaces, bonded layers, markers of a skin, stick and slip."""
