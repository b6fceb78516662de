"""A hand that closes on an object by itself, for scenes whose file says nothing of how it moves."""
