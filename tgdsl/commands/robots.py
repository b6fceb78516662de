"""Commands on robots: their links, layouts and pictures, and conversions of their files."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import SpecError, TgdslError
from tgdsl.files.write import atomic_write_all, check_writable, with_folder

if TYPE_CHECKING:
    from tgdsl.compiler.pipeline import Placed

Hand = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HAND")]


@dataclass(frozen=True)
class Links:
    """Show a robot's tree of bodies: joints, geoms, surface, mass and link groups."""

    robot: args.Robot
    layout: args.OptionalFile = None
    """A layout whose groups are shown; default: the one next to the robot's file."""

    def run(self) -> None:
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


@dataclass(frozen=True)
class New:
    """Propose a layout for a robot: link groups, and taxels at three resolutions; every guess is marked in the file."""

    robot: args.Robot
    density: str = "4/cm2"
    """Taxels per area at the resolution `med`, such as 4/cm2 or 1e4/m2; `low` has a quarter of it, `high` four times it."""
    groups: Literal["auto", "none"] = "auto"
    """Whether to guess the link groups tips, palm, fingers and hand."""
    include: args.Names = ()
    """Names or wildcards of links outside the hand, such as an arm's, that are to have taxels too."""
    out: args.Out = Path("layout.yaml")
    """The file to write."""
    force: args.Replace = False

    def run(self) -> None:
        from tgdsl.files.find import robot_path
        from tgdsl.formats.robot import load_model
        from tgdsl.placement.propose.text import new_layout

        with StatusLine() as progress:
            robot, with_groups = load_model(robot_path(self.robot)), self.groups == "auto"
            lines = new_layout(robot, self.density, with_groups, self.out, self.force, self.include, progress)
        print("\n".join(lines))


@dataclass(frozen=True)
class Freeze:
    """Write down where a layout's taxels are, to the last bit, so that their rows stay when robot, layout or tgdsl change.

    Makes a layout with the same links and groups, and next to it a table (CSV) of the taxels for each resolution.
    """

    hand: Hand
    """A YAML document, the name of a robot, such as `xhand1`, or a robot's file."""
    layout: args.Layout = None
    resolutions: args.Names = ()
    """Resolutions to write down; default: all of the layout."""
    out: args.Out = Path("layout_frozen.yaml")
    """The layout to write; its tables go next to it, layout_frozen.med.csv and so on."""
    force: args.Replace = False
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.compiler.pipeline import all_layouts
        from tgdsl.placement.freeze import frozen_files

        document = args.robot_document(self.hand, self.layout)
        args.refuse_to_replace(self.out, self.force)
        with StatusLine() as progress:
            progress("placing taxels")
            spec, layouts = all_layouts(document, args.parsed_overrides(self.set), self.resolutions)
        files = frozen_files(spec, layouts, self.out, Path(self.hand).name)
        for path in files:
            args.refuse_to_replace(path, self.force)
        atomic_write_all(files)
        print("\n".join(f"{name}: {layout.num_taxels} taxels" for name, layout in layouts.items()))
        print("\n".join(map(str, reversed(files))))


@dataclass(frozen=True)
class Layout:
    """Where taxels sit: new proposes a layout, freeze writes down the taxels of one."""

    action: Annotated[args.subcommands(New, Freeze), tyro.conf.arg(name="")]  # type: ignore[valid-type]
    """What to do."""

    def run(self) -> None:
        self.action.run()


@dataclass(frozen=True)
class Render:
    """Draw a hand and its taxels: a panel per resolution, coloured by link group. Nothing is simulated."""

    hand: Hand
    """A YAML document, an artefact (.safetensors), the name of a robot, such as `xhand1`, or a robot's file."""
    layout: args.Layout = None
    resolutions: args.Names = ()
    """Resolutions to draw; default: the document's own, or all of the layout."""
    keyframe: args.OptionalText = None
    """Keyframe that gives the pose; default: the model's own initial state."""
    view: str = "front"
    """From where: front (what the taxels face), back, left, right, top, bottom, iso, or AZIMUTH,ELEVATION in degrees."""
    size: Annotated[tuple[int, int] | None, args.optional("WIDTH HEIGHT")] = None
    """Pixels of the picture; default: 750 rows, and as many columns as the hand needs."""
    out: args.OptionalOut = None
    """The picture; default: the hand's name with the ending .png, in the working folder."""
    set: args.Overrides = ()

    def run(self) -> None:
        from tgdsl.layout.layout import by_reason, unfelt_ids
        from tgdsl.view.render import render

        out = self.out or args.in_working_folder(self.hand, ".png")
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
        from tgdsl.module.artifact import load_plan
        from tgdsl.scene.scene import scene_model

        if not self.hand.endswith(".safetensors"):
            document = args.robot_document(self.hand, self.layout)
            return placed(document, args.parsed_overrides(self.set), self.resolutions, progress=progress)
        plan = load_plan(self.hand)
        resolution = plan.origin.resolution
        if self.set or self.layout or set(self.resolutions) - {resolution}:
            raise TgdslError(f'an artefact has the layout and resolution it was compiled with, "{resolution}", and no other')
        return Placed(scene_model(plan.scene), {resolution: plan.layout}, {resolution: plan.unfelt})


@dataclass(frozen=True)
class Import:
    """Turn a USD stage into MJCF, with its meshes as .obj files in a folder next to it."""

    stage: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STAGE")]
    """The stage: .usd, .usda, .usdc or .usdz."""
    out: args.OptionalOut = None
    """The MJCF file; default: the stage's name with the ending .xml, in the working folder."""

    def run(self) -> None:
        from tgdsl.formats.mjcf import write_mjcf
        from tgdsl.formats.usd.reader import usd_to_mjcf

        out = check_writable(self.out or args.in_working_folder(self.stage, ".xml"))
        text = usd_to_mjcf(self.stage)
        write_mjcf(text, with_folder(out))
        print(out)


@dataclass(frozen=True)
class ExportUsd:
    """Turn an MJCF or URDF file into a USD stage."""

    robot: Annotated[args.Robot, tyro.conf.arg(help="A file (MJCF, URDF), or the name of a robot that tgdsl brings.")]
    out: args.OptionalOut = None
    """The stage: .usda (text), .usdc or .usd; default: the robot's name with the ending .usda, in the working folder."""

    def run(self) -> None:
        from tgdsl.files.find import robot_path
        from tgdsl.formats.robot import export_model

        file = robot_path(self.robot)
        out = check_writable(self.out or args.in_working_folder(file, ".usda"))
        export_model(file, with_folder(out))
        print(out)
