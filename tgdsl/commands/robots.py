"""Commands on robots: their links, layouts and pictures, and conversions of their files."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
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
    from tgdsl.placement.propose.propose import Draft

Hand = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HAND")]


@dataclass(frozen=True)
class Links:
    """Show a robot's tree of bodies: joints, geoms, surface, mass and link groups."""

    robot: args.Robot
    layout: args.OptionalFile = None
    """A layout whose link groups are shown; default: layout.yaml next to the robot's file."""

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
    density: Annotated[str, tyro.conf.arg(metavar="DENSITY")] = "4/cm2"
    """Taxels per area at resolution `med`, such as 4/cm2 or 1e4/m2; `low` has a quarter of it, `high` four times as many."""
    groups: Literal["auto", "none"] = "auto"
    """auto guesses the link groups tips, palm, fingers and hand."""
    include: args.Names = ()
    """Names or wildcards of further links that get taxels, such as an arm's; default: the hand alone."""
    out: args.Out = Path("layout.yaml")
    """The file to write."""
    force: args.Replace = False
    view: bool = False
    """Change the proposal in the browser, and write the file from there."""

    def run(self) -> None:
        from tgdsl.files.find import robot_path
        from tgdsl.formats.robot import load_model
        from tgdsl.placement.propose.text import new_draft, write_layout

        with StatusLine() as progress:
            robot, with_groups = load_model(robot_path(self.robot)), self.groups == "auto"
            draft = new_draft(robot, self.density, with_groups, self.out, self.force, self.include, progress)
        if self.view:
            self._show(draft)
        else:
            print("\n".join(write_layout(draft, self.out)))

    def _show(self, draft: Draft) -> None:
        from tgdsl.view.layout_page import LayoutPage

        with StatusLine() as progress:
            progress("placing taxels")
            page = LayoutPage(draft, self.out, self.force)
        print(f"{self.robot}: {page.url}   (Ctrl-C ends it)", flush=True)
        try:
            page.run()
        except KeyboardInterrupt:
            pass
        finally:
            page.close()
        print("\n".join(page.written or [f"{self.out}: not written"]))


@dataclass(frozen=True)
class Freeze:
    """Write the exact positions of a layout's taxels, so that rows stay the same if robot, layout or tgdsl change.

    The new layout has the same links and groups, and a table (CSV) of taxels for each resolution.
    """

    hand: Hand
    """A YAML document, a robot's file, or the name of a robot, such as xhand1."""
    layout: args.Layout = None
    resolutions: args.Names = ()
    """Resolutions to write; default: all resolutions of the layout."""
    out: args.Out = Path("layout_frozen.yaml")
    """The layout to write; its tables are written next to it, such as layout_frozen.med.csv."""
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
        counts = [f"{name}: {layout.num_taxels} taxels" for name, layout in layouts.items()]
        _write_new(frozen_files(spec, layouts, self.out, Path(self.hand).name), self.force, counts)


@dataclass(frozen=True)
class FromGates:
    """Write a student's layout with only the taxels that it has chosen by `distill.gates`, at its resolution.

    The new group `chosen` has the links with these taxels. The other links keep theirs, which other sensors may need.
    """

    policy: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="POLICY")]
    """A student with gates, as `tgdsl distill` writes it; its card names the task's document."""
    taxels: args.OptionalInt = None
    """Number of taxels, the widest gates first; default: all open ones."""
    out: args.Out = Path("layout_gates.yaml")
    """The layout to write; its table is written next to it, such as layout_gates.med.csv."""
    force: args.Replace = False

    def run(self) -> None:
        from tgdsl.placement.freeze import frozen_files
        from tgdsl.rl.playing.policy import read_policy
        from tgdsl.rl.students.results import chosen_layout

        args.check_least(self, taxels=1)
        args.refuse_to_replace(self.out, self.force)
        saved = read_policy(self.policy)
        with StatusLine() as progress:
            spec, layouts = chosen_layout(saved, self.taxels, progress)
        _write_new(frozen_files(spec, layouts, self.out, saved.file.name), self.force)


def _write_new(files: dict[Path, bytes], force: bool, notes: Sequence[str] = ()) -> None:
    """Write files, none of which may be there already without `force`; print notes and the files, the last one first."""
    for path in files:
        args.refuse_to_replace(path, force)
    atomic_write_all(files)
    print("\n".join([*notes, *map(str, reversed(files))]))


@dataclass(frozen=True)
class Layout:
    """Propose a layout of taxels for a robot, freeze one, or choose taxels that a student needs."""

    action: Annotated[args.subcommands(New, Freeze, FromGates), tyro.conf.arg(name="")]  # type: ignore[valid-type]
    """What to do."""

    def run(self) -> None:
        self.action.run()


@dataclass(frozen=True)
class Render:
    """Draw a hand and its taxels: a panel per resolution, coloured by link group. Nothing is simulated."""

    hand: Hand
    """A YAML document, an artefact (.safetensors), a robot's file, or the name of a robot, such as xhand1."""
    layout: args.Layout = None
    resolutions: args.Names = ()
    """Resolutions to draw; default: the document's, or all resolutions of the layout."""
    keyframe: args.OptionalName = None
    """Keyframe of the pose; default: the model's initial state."""
    view: Annotated[str, tyro.conf.arg(metavar="VIEW")] = "front"
    """Viewpoint: front (the side that taxels face), back, left, right, top, bottom, iso, or AZIMUTH,ELEVATION [degrees]."""
    size: Annotated[tuple[int, int] | None, args.optional("WIDTH HEIGHT")] = None
    """Size of the picture [pixels]; default: 750 high, and as wide as needed."""
    out: args.OptionalOut = None
    """The picture; default: the hand's name with .png, in the working folder."""
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
        """Return the model and the layouts to draw by resolution, from an artefact or a document."""
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
    """Convert a USD stage to MJCF; its meshes become .obj files in a folder next to it."""

    stage: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STAGE")]
    """The stage: .usd, .usda, .usdc or .usdz."""
    out: args.OptionalOut = None
    """The MJCF file; default: the stage's name with .xml, in the working folder."""

    def run(self) -> None:
        from tgdsl.formats.mjcf import write_mjcf
        from tgdsl.formats.usd.reader import usd_to_mjcf

        out = check_writable(self.out or args.in_working_folder(self.stage, ".xml"))
        text = usd_to_mjcf(self.stage)
        write_mjcf(text, with_folder(out))
        print(out)


@dataclass(frozen=True)
class ExportUsd:
    """Convert an MJCF or URDF file to a USD stage."""

    robot: Annotated[
        args.Robot, tyro.conf.arg(help="A robot's file (MJCF, URDF), or the name of a robot that comes with tgdsl.")
    ]
    out: args.OptionalOut = None
    """The stage: .usda (text), .usdc or .usd; default: the robot's name with .usda, in the working folder."""

    def run(self) -> None:
        from tgdsl.files.find import robot_path
        from tgdsl.formats.robot import export_model

        file = robot_path(self.robot)
        out = check_writable(self.out or args.in_working_folder(file, ".usda"))
        export_model(file, with_folder(out))
        print(out)
