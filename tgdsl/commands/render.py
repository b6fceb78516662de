"""`tgdsl render`: a picture of a hand and its taxels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import OUT, OptionalFile, Overrides, in_working_folder, parsed_overrides, robot_document
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    from tgdsl.compiler.pipeline import Placed


@dataclass(frozen=True)
class Render:
    """Draw a hand and its taxels: a panel per resolution, coloured by link group. Nothing is simulated."""

    hand: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HAND")]
    """A YAML document, an artefact (.safetensors), the name of a robot, such as `xhand1`, or a robot's file."""
    layout: OptionalFile = None
    """Layout of a robot; default: the one next to its file."""
    resolutions: tuple[str, ...] = ()
    """Resolutions to draw; default: the document's own, or all of the layout."""
    keyframe: str | None = None
    """Keyframe that gives the pose; default: the model's own initial state."""
    view: str = "front"
    """From where: front (what the taxels face), back, left, right, top, bottom, iso, or AZIMUTH,ELEVATION in degrees."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Pixels of the picture; default: 750 rows, and as many columns as the hand needs."""
    out: Annotated[Path | None, OUT] = None
    """The picture; default: the hand's name with the ending .png, in the working folder."""
    set: Overrides = ()

    def run(self) -> None:
        """Draw, write and say how many taxels there are."""
        from tgdsl.layout.layout import by_reason, unfelt_ids
        from tgdsl.view.render import render

        out = self.out or in_working_folder(self.hand, ".png")
        with StatusLine() as progress:
            model, layouts, unfelt = self._placed(progress)
            progress("drawing the picture")
            path = render(model, layouts, out, keyframe=self.keyframe, view=self.view, size=self.size, unfelt=unfelt)
        print(", ".join(f"{name}: {layout.num_taxels} taxels" for name, layout in layouts.items()))
        for name, taxels in unfelt.items():
            if taxels:
                print(f"{name}: {len(unfelt_ids(taxels))} taxels cannot feel: {by_reason(taxels)}")
        print(f"picture: {path}")

    def _placed(self, progress: StatusLine) -> Placed:
        """Return the model and the layouts to draw by resolution: an artefact's, or those of a document."""
        from tgdsl.compiler.pipeline import Placed, placed

        if not self.hand.endswith(".safetensors"):
            return placed(
                robot_document(self.hand, self.layout), parsed_overrides(self.set), self.resolutions, progress=progress
            )
        from tgdsl.module.artifact import load_plan
        from tgdsl.scene.scene import scene_model

        plan = load_plan(self.hand)
        resolution = plan.origin.resolution
        if self.set or self.layout or set(self.resolutions) - {resolution}:
            raise TgdslError(f'an artefact has the layout and resolution it was compiled with, "{resolution}", and no other')
        return Placed(scene_model(plan.scene), {resolution: plan.layout}, {resolution: plan.unfelt})
