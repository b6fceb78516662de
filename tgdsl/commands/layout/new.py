"""`tgdsl layout new`: a proposal of where taxels sit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tgdsl.commands.arguments import OUT, Replace, Robot


@dataclass(frozen=True)
class New:
    """Propose a layout for a robot: link groups, and taxels at three resolutions; every guess is marked in the file."""

    robot: Robot
    density: str = "4/cm2"
    """Taxels per area at the resolution `med`, such as 4/cm2 or 1e4/m2; `low` has a quarter of it, `high` four times it."""
    groups: Literal["auto", "none"] = "auto"
    """Whether to guess the link groups tips, palm, fingers and hand."""
    include: tuple[str, ...] = ()
    """Names or wildcards of links outside the hand, such as an arm's, that are to have taxels too."""
    out: Annotated[Path, OUT] = Path("layout.yaml")
    """The file to write."""
    force: Replace = False

    def run(self) -> None:
        """Write the layout and say what it holds."""
        from tgdsl.console.progress import StatusLine
        from tgdsl.files.find import robot_path
        from tgdsl.formats.robot import load_model
        from tgdsl.placement.propose.text import new_layout

        with StatusLine() as progress:
            robot, with_groups = load_model(robot_path(self.robot)), self.groups == "auto"
            lines = new_layout(robot, self.density, with_groups, self.out, self.force, self.include, progress)
        for line in lines:
            print(line)
