"""Commands on robots: `tgdsl links`, `layout new`, `import` and `export-usd`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

Robot = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROBOT")]


@dataclass(frozen=True)
class Links:
    """Show a robot's tree of bodies: joints, geoms, surface, mass and link groups."""

    robot: Robot
    """A file (MJCF, URDF, USD), or the name of a robot that tgdsl brings."""
    layout: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A layout whose groups are shown; default: that of a robot given by name."""

    def run(self) -> None:
        """Print the table."""
        from tgdsl.placement.links import layout_of, links_table, open_robot

        print("\n".join(links_table(open_robot(self.robot), self.layout or layout_of(self.robot))))


@dataclass(frozen=True)
class LayoutNew:
    """Propose a layout for a robot: link groups, and taxels at three resolutions; every guess is marked in the file."""

    action: Annotated[tyro.conf.Positional[Literal["new"]], tyro.conf.arg(metavar="new")]
    """What to do: `new` proposes one."""
    robot: Robot
    """A file (MJCF, URDF, USD), or the name of a robot that tgdsl brings."""
    density: str = "4/cm2"
    """Taxels per area at the resolution `med`, such as 4/cm2 or 1e4/m2; `low` has a quarter of it, `high` four times it."""
    groups: Literal["auto", "none"] = "auto"
    """Whether to guess the link groups tips, palm, fingers and hand."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = Path("layout.yaml")
    """The file to write."""
    force: bool = False
    """Replace the file if it is there."""

    def run(self) -> None:
        """Write the layout and say what it holds."""
        from tgdsl.placement.links import open_robot
        from tgdsl.placement.propose.text import new_layout

        for line in new_layout(open_robot(self.robot), self.density, self.groups == "auto", self.out, self.force):
            print(line)


@dataclass(frozen=True)
class Import:
    """Turn a USD stage into MJCF, with its meshes as .obj files in a folder beside it."""

    stage: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STAGE")]
    """The stage: .usd, .usda, .usdc or .usdz."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """The MJCF file; default: the stage's name with the ending .xml, in the working folder."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.files.files import with_folder, writable
        from tgdsl.formats.mjcf import write_mjcf
        from tgdsl.formats.usd.reader import usd_to_mjcf

        out = writable(self.out or Path(self.stage.with_suffix(".xml").name))
        text = usd_to_mjcf(self.stage)
        write_mjcf(text, with_folder(out))
        print(out)


@dataclass(frozen=True)
class ExportUsd:
    """Turn an MJCF or URDF file into a USD stage."""

    robot: Robot
    """A file (MJCF, URDF), or the name of a robot that tgdsl brings."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """The stage: .usda (text), .usdc or .usd; default: the robot's name with the ending .usda, in the working folder."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.files.files import with_folder, writable
        from tgdsl.formats.robot import export_model
        from tgdsl.placement.links import robot_path

        file = robot_path(self.robot)
        out = writable(self.out or Path(file.with_suffix(".usda").name))
        export_model(file, with_folder(out))
        print(out)
