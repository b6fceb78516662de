"""Contact depth: how deep a probe is in which object, which way is out, how that moves."""
