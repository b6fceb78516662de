"""`tgdsl layout`: all commands on layouts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from tgdsl.commands.layout.freeze import Freeze
from tgdsl.commands.layout.new import New

Action = Annotated[New, tyro.conf.subcommand("new")] | Annotated[Freeze, tyro.conf.subcommand("freeze")]
"""Every command on layouts by its name."""


@dataclass(frozen=True)
class Layout:
    """Where taxels sit: new proposes a layout, freeze writes down the taxels of one."""

    action: Annotated[Action, tyro.conf.arg(name="")]
    """What to do."""

    def run(self) -> None:
        """Do it."""
        self.action.run()
