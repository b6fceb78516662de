"""Speed against error, oracles, and the state of an installation."""
