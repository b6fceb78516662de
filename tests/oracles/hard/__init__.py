"""The numerical hard cases of all kinds: what could go wrong, and how far a module is from its kind's float64 definition."""
