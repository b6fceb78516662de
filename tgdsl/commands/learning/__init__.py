"""Commands of learning: `tgdsl train` and `tgdsl evaluate`."""
