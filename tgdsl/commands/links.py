"""`tgdsl links`: a robot's tree of bodies."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from tgdsl.commands.arguments import OptionalFile, Robot
from tgdsl.errors import SpecError


@dataclass(frozen=True)
class Links:
    """Show a robot's tree of bodies: joints, geoms, surface, mass and link groups."""

    robot: Robot
    layout: OptionalFile = None
    """A layout whose groups are shown; default: the one next to the robot's file."""

    def run(self) -> None:
        """Print the table."""
        from tgdsl.files.find import layout_of, robot_path
        from tgdsl.formats.robot import load_model
        from tgdsl.placement.links import links_table

        robot, beside = load_model(robot_path(self.robot)), layout_of(self.robot)
        try:
            lines = links_table(robot, self.layout or beside)
        except SpecError as error:
            if self.layout is not None:
                raise
            problem = "the layout next to this robot does not fit it, so no groups are shown"
            warnings.warn(f"{error.problems[0]}; {problem}", stacklevel=2)
            lines = links_table(robot)
        print("\n".join(lines))
