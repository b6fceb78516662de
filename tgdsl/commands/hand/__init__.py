"""`tgdsl hand`, one file per command."""
