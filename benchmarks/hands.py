"""Take hands and grippers of other packages through all stages: links, layout, render, USD, compile, explain, run, compare.

    pip install --no-deps gymnasium-robotics robosuite dm_control orca-sim gym-aloha mani-skill genesis-world
    python benchmarks/hands.py [NAME ...] [--out out/hands] [--pictures docs/images/hands]

Hands whose package is not installed are skipped. No file is edited: a layout is proposed, and four kinds of sensor on its group
`hand` feel a ball, on which `tgdsl run` closes the hand. Readings are compared with MuJoCo's functions in float64 (see
`hand_checks`): depths with `mj_geomDistance`, forces with `mj_contactForce`.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, dataclass, field
from io import StringIO
from pathlib import Path

import mujoco
import numpy as np
from hand_checks import check
from PIL import Image

from tgdsl.commands.documents import Compile, Explain, Run
from tgdsl.commands.robots import ExportUsd, Import, Links, New, Render
from tgdsl.compiler.pipeline import placed
from tgdsl.errors import TgdslError
from tgdsl.formats.robot import load_model
from tgdsl.module.artifact import load
from tgdsl.placement.propose.propose import FACTORS
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.closing.closing import START, closing_of
from tgdsl.runtime.rollout import controls_between

DENSITY = "1/cm2"
"""Taxels per area at `med`."""
RADII = (0.025, 0.015, 0.01, 0.006)
"""Radii of the ball to try, largest first [m]."""
SECONDS = 1.0
"""Duration of each phase: the hand is open, closes, and is closed [s]."""
SUBSTEPS = 10
"""Physics steps per control step of `tgdsl run`."""
TIMEOUT = 600.0
"""Time limit of a hand [s]."""
INSTANTS = 12
"""States of a grasp at which readings are compared."""
LIMIT = 1e-9
"""Limit of the errors of depths [m] and forces [N]."""
SENSORS = {"depth": "contact_depth", "touch": "kinematic_taxel", "force": "force_taxel", "solver": "link_contact"}
"""Names and kinds of the document's sensors."""


@dataclass(frozen=True)
class Hand:
    """A hand's package, and the path of its file inside."""

    package: str
    file: str


_SUITE = "robosuite/models/assets/grippers/"
_MANI = "mani_skill/assets/robots/"
_DATA = "cmeel.prefix/share/example-robot-data/robots/"
HANDS = {
    "shadow": Hand("gymnasium-robotics", "gymnasium_robotics/envs/assets/hand/reach.xml"),
    "adroit": Hand("gymnasium-robotics", "gymnasium_robotics/envs/assets/adroit_hand/adroit_relocate.xml"),
    "shadow_e": Hand(
        "dexterity", "dexterity/models/vendor/shadow_robot/shadow_hand_description/mjcf/shadow_hand_position_actuators.xml"
    ),
    "orca": Hand("orca_sim", "orca_sim/scene_right.xml"),
    "allegro": Hand("example-robot-data", f"{_DATA}allegro_hand_description/urdf/allegro_right_hand.urdf"),
    "allegro_left": Hand("mani-skill", f"{_MANI}allegro/allegro_hand_left.urdf"),
    "ability": Hand("mani-skill", f"{_MANI}ability_hand/ability_hand_right.urdf"),
    "inspire": Hand("robosuite", f"{_SUITE}inspire_right_hand.xml"),
    "inspire_left": Hand("robosuite", f"{_SUITE}inspire_left_hand.xml"),
    "inspire_urdf": Hand("mani-skill", f"{_MANI}inspire_hand/RH56DFX-2LR/urdf/inspire_hand_right.urdf"),
    "fourier": Hand("robosuite", f"{_SUITE}fourier_right_hand.xml"),
    "shadow_urdf": Hand("genesis-world", "genesis/assets/urdf/shadow_hand/shadow_hand.urdf"),
    "leap_kaizen": Hand("ghand", "ghand/assets/models/urdf/ghand_right.urdf"),
    "dclaw": Hand("mani-skill", f"{_MANI}dclaw/dclaw_gripper_glb.urdf"),
    "jaco": Hand("robosuite", f"{_SUITE}jaco_three_finger_gripper.xml"),
    "jaco_hand": Hand("dm_control", "dm_control/third_party/kinova/jaco_hand.xml"),
    "robotiq_s": Hand("robosuite", f"{_SUITE}robotiq_gripper_s.xml"),
    "robotiq_140": Hand("robosuite", f"{_SUITE}robotiq_gripper_140.xml"),
    "robotiq_85": Hand("airo-models", "airo_models/grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf"),
    "panda": Hand("genesis-world", "genesis/assets/xml/franka_emika_panda/hand.xml"),
    "panda_suite": Hand("robosuite", f"{_SUITE}panda_gripper.xml"),
    "rethink": Hand("robosuite", f"{_SUITE}rethink_gripper.xml"),
    "spot": Hand("robosuite", f"{_SUITE}bd_gripper.xml"),
    "pr2": Hand("pybullet", "pybullet_data/pr2_gripper.urdf"),
    "xarm": Hand("pybullet", "pybullet_data/xarm/xarm6_with_gripper.urdf"),
    "so100": Hand("mani-skill", f"{_MANI}so100/so100.urdf"),
    "viperx": Hand("gym-aloha", "gym_aloha/assets/bimanual_viperx_transfer_cube.xml"),
}


@dataclass
class Row:
    """Results of a hand.

    Attributes:
        name: Name of the hand.
        version: Version of the package.
        joints: Number of the robot's joints.
        links: Number of links with taxels.
        taxels: Number of taxels at each resolution.
        groups: Number of links in each proposed group.
        outside: Share of the taxels at `med` on links outside `hand`.
        facing: Number of links whose inner side was recognised.
        warnings: Distinct warnings, and output past Python, with their stage.
        explained: Lines of `explain` about taxels that feel nothing.
        felt: Errors and contacts, see `hand_checks.Checked`.
        usd: Differences of the robot imported from USD; empty without any.
        seconds: Time of each stage [s].
        error: Failed stages, and reasons.
    """

    name: str
    version: str
    joints: int = 0
    links: int = 0
    taxels: dict[str, int] = field(default_factory=dict)
    groups: dict[str, int] = field(default_factory=dict)
    outside: float = 0.0
    facing: int = 0
    warnings: list[str] = field(default_factory=list)
    explained: list[str] = field(default_factory=list)
    felt: dict[str, float] = field(default_factory=dict)
    usd: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    error: str = ""


def locate(hand: Hand) -> tuple[Path, str] | None:
    """Return a hand's file and its package's version; None if it is not installed."""
    try:
        distribution = importlib.metadata.distribution(hand.package)
    except importlib.metadata.PackageNotFoundError:
        return None
    file = Path(str(distribution.locate_file(hand.file)))
    return (file, distribution.version) if file.is_file() else None


class Stages:
    """The stages of a hand."""

    def __init__(self, name: str, file: Path, version: str, out: Path, pictures: Path | None):
        """Create the folder for the files of the stages."""
        self.row, self.file, self.folder = Row(name, version), file.resolve(), out / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self.layout, self.document = self.folder / "layout.yaml", self.folder / "hand.yaml"
        self.picture = (pictures or self.folder) / f"{name}.png"
        self.artefact = self.folder / "hand.safetensors"

    def run(self) -> Row:
        """Take the hand through all stages; failures are in the row, and stages that depend on a failed one are skipped."""
        stages: tuple[Callable[[], None], ...] = (
            *(self.links, self.layout_new, self.render, self.usd),
            *(self.compile, self.explain, self.run_scene, self.compare),
        )
        for stage in stages:
            start, messages = time.perf_counter(), []
            try:
                with collected_messages(messages):
                    stage()
            except Exception as error:  # the row names the failure, and the table goes on
                message = str(error) if isinstance(error, TgdslError) else f"{type(error).__name__}: {error}"
                self.row.error += f"{stage.__name__}: {message}\n"
            self.row.seconds[stage.__name__] = round(time.perf_counter() - start, 1)
            self.row.warnings += [f"{stage.__name__}: {text}" for text in dict.fromkeys(messages)]
            (self.folder / "row.json").write_text(json.dumps(asdict(self.row), indent=1))
            if self.row.error and stage.__name__ not in ("render", "usd", "explain", "run_scene"):
                break
        return self.row

    def links(self) -> None:
        """Run `tgdsl links`."""
        output_of(Links(str(self.file)).run)
        self.row.joints = load_model(self.file).compiled.njnt

    def layout_new(self) -> None:
        """Run `tgdsl layout new`, and count its proposals."""
        output_of(New(str(self.file), density=DENSITY, out=self.layout, force=True).run)
        by_resolution = placed(self._robot()).layouts
        self.row.taxels = {name: layout.num_taxels for name, layout in by_resolution.items()}
        self.med = by_resolution["med"]
        self.row.links = len(self.med.links)
        self.row.groups = {name: len(members) for name, members in self.med.groups.items()}
        inside = len(self.med.taxels_of(self.med.groups.get("hand", ())))
        self.row.outside = round(1.0 - inside / self.med.num_taxels, 3)
        text = self.layout.read_text().split("  med:")[1].split("  high:")[0]
        self.row.facing = text.count("facing:")

    def render(self) -> None:
        """Run `tgdsl render` at `med`, small."""
        self.picture.parent.mkdir(parents=True, exist_ok=True)
        view = Render(str(self.file), self.layout, ("med",), view="iso", size=(360, 360), out=self.picture)
        output_of(view.run)
        with Image.open(self.picture) as picture:
            colours = picture.convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE, colors=64)
        colours.save(self.picture, optimize=True)

    def compile(self) -> None:
        """Run `tgdsl compile` on a document with the largest ball that fits into the hand."""
        reason = ""
        for radius in RADII:
            self.document.write_text(json.dumps(self._document(radius), indent=1))  # JSON is YAML
            output_of(Compile(self.document, out=self.artefact).run)
            closing = closing_of(load(self.artefact))
            if not isinstance(closing, str):
                self.closing = closing
                return
            reason = closing
            if "does not fit" not in reason:  # then a smaller ball does not help
                break
        raise TgdslError(f"the hand closes on no ball of {1e3 * min(RADII):g} to {1e3 * max(RADII):g} mm: {reason}")

    def explain(self) -> None:
        """Run `tgdsl explain`; select its lines about taxels that feel nothing."""
        text = output_of(Explain(self.artefact).run)
        self.row.explained = [line.strip() for line in text.splitlines() if re.search("buried|deaf|feel nothing|never", line)]

    def run_scene(self) -> None:
        """Run `tgdsl run`: the hand opens and closes on the ball."""
        output_of(Run(self.artefact, seconds=SECONDS, substeps=SUBSTEPS, out=self.folder).run)

    def compare(self) -> None:
        """Compare readings with MuJoCo's functions."""
        touch = load(self.artefact, dtype="float64")
        sim = BatchSimulation(touch, 1, keyframe=START, prepare=self.closing.prepare)
        control = controls_between(self.closing.targets(sim.model.nu), SECONDS, sim.control_step)
        self.row.felt = asdict(check(touch, sim, control, INSTANTS))
        errors = {name: self.row.felt[name] for name in ("depth", "force")}
        if not all(error <= LIMIT for error in errors.values()):
            raise TgdslError(f"readings differ from MuJoCo's: {errors}")
        if not self.row.felt["links"]:
            raise TgdslError("the hand does not reach the ball")

    def usd(self) -> None:
        """Run `tgdsl export-usd` and `tgdsl import`, and compare the imported robot."""
        stage, imported = self.folder / "robot.usda", self.folder / "back.xml"
        output_of(ExportUsd(str(self.file), stage).run)
        output_of(Import(stage, imported).run)
        self.row.usd = difference(load_model(self.file).compiled, load_model(imported).compiled)

    def _document(self, radius: float) -> dict[str, object]:
        return {
            **self._robot(),
            "objects": {"ball": {"geom": {"type": "sphere", "size": [radius]}}},
            "resolution": "med",
            "sensors": {name: {"kind": kind, "links": "hand", "feels": ["ball"]} for name, kind in SENSORS.items()},
        }

    def _robot(self) -> dict[str, object]:
        return {"tgdsl": 1, "robot": {"model": str(self.file), "layout": str(self.layout)}}


def difference(one: mujoco.MjModel, two: mujoco.MjModel) -> str:
    """Return the differences of two robots: counts, mass, and positions of bodies of the same name at the start."""
    parts = []
    for name in ("nbody", "njnt", "ngeom", "nu", "neq", "ntendon"):
        if getattr(one, name) != getattr(two, name):
            parts.append(f"{name} {getattr(one, name)} → {getattr(two, name)}")
    if abs(one.body_mass.sum() - two.body_mass.sum()) > 1e-6:
        parts.append(f"mass {one.body_mass.sum():.4g} → {two.body_mass.sum():.4g} kg")
    positions = []
    for model in (one, two):
        state = mujoco.MjData(model)
        mujoco.mj_kinematics(model, state)
        positions.append({model.body(i).name: state.xpos[i] for i in range(model.nbody)})
    common = positions[0].keys() & positions[1].keys() - {""}
    if lost := sorted(positions[0].keys() - common - {""}):
        parts.append(f"without {', '.join(lost)}")
    if common and (offset := max(float(np.abs(positions[0][n] - positions[1][n]).max()) for n in common)) > 1e-6:
        parts.append(f"bodies off by {1e3 * offset:.2g} mm")
    return ", ".join(parts)


def output_of(command: Callable[[], None]) -> str:
    """Run a command and return its output."""
    text = StringIO()
    with redirect_stdout(text):
        command()
    return text.getvalue()


@contextmanager
def collected_messages(messages: list[str]) -> Iterator[None]:
    """Collect warnings, and output to the descriptors of standard output and error."""
    sys.stdout.flush()
    sys.stderr.flush()
    originals = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as file, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for number in (1, 2):
            os.dup2(file.fileno(), number)
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for original, number in zip(originals, (1, 2), strict=True):
                os.dup2(original, number)
                os.close(original)
            file.seek(0)
            messages += [f"(raw) {line.strip()}" for line in file.read().decode(errors="replace").splitlines() if line.strip()]
            messages += [f"{entry.category.__name__}: {entry.message}" for entry in caught]


def lines_of(row: Row, hand: Hand) -> list[str]:
    """Return a row as lines of text."""
    counts = " ".join(f"{row.taxels.get(name, 0):>6}" for name in FACTORS)
    groups = " ".join(f"{name} {count}" for name, count in row.groups.items())
    felt = ""
    if row.felt:
        felt = "; {links} links, {taxels} taxels, {newtons:.2f} N; errors {depth:.0e} m, {force:.0e} N".format(**row.felt)
    lines = [f"{row.name:<14}{row.joints:>4} joints {row.links:>3} links ({row.facing} facing) {counts}  {groups}"]
    lines.append(
        f"    {hand.package} {row.version}; {100 * row.outside:.0f} % outside `hand`{felt}; USD: {row.usd or 'the same'}"
    )
    lines.append("    " + ", ".join(f"{stage} {seconds:g} s" for stage, seconds in row.seconds.items()))
    lines += [f"    explain: {line}" for line in row.explained]
    lines += [f"    warned: {text[:400]}" for text in row.warnings[:12]]
    if len(row.warnings) > 12:
        lines.append(f"    and {len(row.warnings) - 12} more")
    return lines + [f"    FAILED in {line}" for line in row.error.splitlines()]


def main() -> int:
    """Print the table; return the number of hands that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(HANDS)}; default: all")
    parser.add_argument("--out", type=Path, default=Path("out/hands"), help="folder for the stages' files")
    parser.add_argument("--pictures", type=Path, help="folder for the pictures; default: in --out")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in HANDS]:
        parser.error(f"there is no hand {', '.join(unknown)}; expected some of {', '.join(HANDS)}")
    failed = 0
    for name in options.names or HANDS:
        location = locate(HANDS[name])
        if location is None:
            print(f"{name:<14} skipped: {HANDS[name].package} with {HANDS[name].file} is not installed", flush=True)
            continue
        if options.child:
            Stages(name, *location, options.out, options.pictures).run()
            continue
        row = run_child(name, location[1], options)
        failed += bool(row.error)
        print("\n".join(lines_of(row, HANDS[name])), flush=True)
    return failed


def run_child(name: str, version: str, options: argparse.Namespace) -> Row:
    """Return a hand's row from a separate process, which may crash or hang."""
    file = options.out / name / "row.json"
    file.unlink(missing_ok=True)
    command = [sys.executable, __file__, name, "--child", "--out", str(options.out)]
    command += ["--pictures", str(options.pictures)] if options.pictures else []
    reason = ""
    try:
        child = subprocess.run(command, timeout=TIMEOUT, capture_output=True, text=True)
        if child.returncode:
            reason = f"exit code {child.returncode}: {child.stderr.strip()[-300:]}"
    except subprocess.TimeoutExpired:
        reason = f"not done after {TIMEOUT:g} s"
    row = Row(**json.loads(file.read_text())) if file.is_file() else Row(name, version)
    row.error += reason
    return row


if __name__ == "__main__":
    sys.exit(main())
