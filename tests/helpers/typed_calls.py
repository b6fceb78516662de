"""The type checker of `--check-types`: beartype, reading hints as pyright does."""

from typing import Self

from beartype import BeartypeConf, FrozenDict, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict({Self: object})))
"""An int is a float. `Self` passes unchecked: beartype takes it only where it decorates a whole class."""
