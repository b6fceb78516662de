"""`tgdsl layout freeze`: the taxels of a layout, written down point by point."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import (
    OUT,
    OptionalFile,
    Overrides,
    Replace,
    parsed_overrides,
    refuse_to_replace,
    robot_document,
)


@dataclass(frozen=True)
class Freeze:
    """Write down where a layout's taxels are, to the last bit, so that their rows stay when robot, layout or tgdsl change.

    Makes a layout with the same links and groups, and next to it a table (CSV) of the taxels for each resolution.
    """

    hand: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HAND")]
    """A YAML document, the name of a robot, such as `xhand1`, or a robot's file."""
    layout: OptionalFile = None
    """Layout of a robot; default: the one next to its file."""
    resolutions: tuple[str, ...] = ()
    """Resolutions to write down; default: all of the layout."""
    out: Annotated[Path, OUT] = Path("layout_frozen.yaml")
    """The layout to write; its tables go next to it, layout_frozen.med.csv and so on."""
    force: Annotated[Replace, tyro.conf.arg(help="Replace the files if they are there.")] = False
    set: Overrides = ()

    def run(self) -> None:
        """Write the files and say what they hold."""
        from tgdsl.compiler.pipeline import all_layouts
        from tgdsl.files.write import atomic_write_all
        from tgdsl.placement.freeze import frozen_files

        document = robot_document(self.hand, self.layout)
        refuse_to_replace(self.out, self.force)
        spec, layouts = all_layouts(document, parsed_overrides(self.set), self.resolutions)
        files = frozen_files(spec, layouts, self.out, Path(self.hand).name)
        for path in files:
            refuse_to_replace(path, self.force)
        atomic_write_all(files)
        print("\n".join(f"{name}: {layout.num_taxels} taxels" for name, layout in layouts.items()))
        print("\n".join(map(str, reversed(files))))
