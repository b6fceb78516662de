"""`tgdsl links`: a robot's tree of bodies."""

from __future__ import annotations

from dataclasses import dataclass

from tgdsl.commands.arguments import OptionalFile, Robot


@dataclass(frozen=True)
class Links:
    """Show a robot's tree of bodies: joints, geoms, surface, mass and link groups."""

    robot: Robot
    layout: OptionalFile = None
    """A layout whose groups are shown; default: that of a robot given by name."""

    def run(self) -> None:
        """Print the table."""
        from tgdsl.placement.links import layout_of, links_table, open_robot

        print("\n".join(links_table(open_robot(self.robot), self.layout or layout_of(self.robot))))
