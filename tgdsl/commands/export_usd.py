"""`tgdsl export-usd`: a robot to a USD stage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import OUT, Robot, in_working_folder


@dataclass(frozen=True)
class ExportUsd:
    """Turn an MJCF or URDF file into a USD stage."""

    robot: Annotated[Robot, tyro.conf.arg(help="A file (MJCF, URDF), or the name of a robot that tgdsl brings.")]
    out: Annotated[Path | None, OUT] = None
    """The stage: .usda (text), .usdc or .usd; default: the robot's name with the ending .usda, in the working folder."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.files.find import robot_path
        from tgdsl.files.write import check_writable, with_folder
        from tgdsl.formats.robot import export_model

        file = robot_path(self.robot)
        out = check_writable(self.out or in_working_folder(file, ".usda"))
        export_model(file, with_folder(out))
        print(out)
