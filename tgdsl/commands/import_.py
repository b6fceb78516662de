"""`tgdsl import`: a USD stage to MJCF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import OUT, in_working_folder


@dataclass(frozen=True)
class Import:
    """Turn a USD stage into MJCF, with its meshes as .obj files in a folder next to it."""

    stage: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STAGE")]
    """The stage: .usd, .usda, .usdc or .usdz."""
    out: Annotated[Path | None, OUT] = None
    """The MJCF file; default: the stage's name with the ending .xml, in the working folder."""

    def run(self) -> None:
        """Write it."""
        from tgdsl.files.write import check_writable, with_folder
        from tgdsl.formats.mjcf import write_mjcf
        from tgdsl.formats.usd.reader import usd_to_mjcf

        out = check_writable(self.out or in_working_folder(self.stage, ".xml"))
        text = usd_to_mjcf(self.stage)
        write_mjcf(text, with_folder(out))
        print(out)
