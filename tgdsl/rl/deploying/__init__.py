"""Policies that act on what `tgdsl.connect` connects to: a simulation, an emulated hand, a real one, a log."""
