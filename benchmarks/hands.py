"""Hands and grippers that other packages bring, through the whole line: links, layout, compile, explain, run, render, USD.

    pip install --no-deps gymnasium-robotics robosuite dm_control orca-sim gym-aloha mani-skill genesis-world
    python benchmarks/hands.py [NAME ...] [--out out/hands] [--pictures docs/images/hands]

Each hand is looked for inside its installed package; one that is not there is skipped by name. Nothing of a file is edited: a
layout is proposed, and a document of four kinds of sensor on its group `hand` feels a ball on which `tgdsl run` closes it. On
the way the readings are checked against MuJoCo's own, in float64 (see `hand_checks`): depths against `mj_geomDistance`,
forces against `mj_contactForce`.
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
"""Radii of the ball that are tried, from the largest [m]."""
SECONDS = 1.0
"""How long the hand is open, closes, and is closed [s]."""
SUBSTEPS = 10
"""Physics steps per control step of `tgdsl run`."""
INSTANTS = 12
"""States of a grasp at which readings are compared with MuJoCo's."""
LIMIT = 1e-9
"""Largest error of a depth [m] and of a force [N]."""
SENSORS = {"depth": "contact_depth", "touch": "kinematic_taxel", "force": "force_taxel", "solver": "link_contact"}
"""The document's sensors, by name: their kinds."""


@dataclass(frozen=True)
class Hand:
    """Where a hand's file is: in which installed package, and where inside of it."""

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
    """What came of a hand.

    Attributes:
        name: The hand's.
        version: The package's.
        joints: Joints of the robot.
        links: Links with taxels.
        taxels: Number of them at each resolution.
        groups: Members of each proposed group, groups resolved.
        outside: Share of the taxels at `med` on links that are not in `hand`.
        facing: Links whose inner side was found.
        warnings: What was warned of or printed past Python, each once, by stage.
        explained: Lines of `explain` about taxels that feel nothing.
        felt: What the hand felt of the ball, see `hand_checks.Checked`.
        usd: How the robot differs that came back from USD; empty if it does not.
        seconds: Time of each stage [s].
        error: The stage that failed, and why.
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


def found(hand: Hand) -> tuple[Path, str] | None:
    """Return a hand's file and its package's version; None if that is not installed."""
    try:
        distribution = importlib.metadata.distribution(hand.package)
    except importlib.metadata.PackageNotFoundError:
        return None
    file = Path(str(distribution.locate_file(hand.file)))
    return (file, distribution.version) if file.is_file() else None


class Line:
    """The stages, for one hand."""

    def __init__(self, name: str, file: Path, version: str, out: Path, pictures: Path | None):
        """Prepare a folder of its own for the files of the stages."""
        self.row, self.file, self.folder = Row(name, version), file.resolve(), out / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self.layout, self.document = self.folder / "layout.yaml", self.folder / "hand.yaml"
        self.picture = (pictures or self.folder) / f"{name}.png"
        self.artefact = self.folder / "hand.safetensors"

    def run(self) -> Row:
        """Take the hand through all stages; what fails ends in the row, and what needs it is left out."""
        stages: tuple[Callable[[], None], ...] = (
            *(self.links, self.layout_new, self.render, self.usd),
            *(self.compile, self.explain, self.run_scene, self.compare),
        )
        for stage in stages:
            start, said = time.perf_counter(), []
            try:
                with overheard(said):
                    stage()
            except Exception as error:  # a row says what failed, and the table goes on
                what = str(error) if isinstance(error, TgdslError) else f"{type(error).__name__}: {error}"
                self.row.error += f"{stage.__name__}: {what}\n"
            self.row.seconds[stage.__name__] = round(time.perf_counter() - start, 1)
            self.row.warnings += [f"{stage.__name__}: {text}" for text in dict.fromkeys(said)]
            (self.folder / "row.json").write_text(json.dumps(asdict(self.row), indent=1))
            if self.row.error and stage.__name__ not in ("render", "usd", "explain", "run_scene"):
                break
        return self.row

    def links(self) -> None:
        """`tgdsl links`."""
        printed(Links(str(self.file)).run)
        self.row.joints = load_model(self.file).compiled.njnt

    def layout_new(self) -> None:
        """`tgdsl layout new`, and what it proposed."""
        printed(New(str(self.file), density=DENSITY, out=self.layout, force=True).run)
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
        """`tgdsl render`, at `med`, small."""
        self.picture.parent.mkdir(parents=True, exist_ok=True)
        view = Render(str(self.file), self.layout, ("med",), view="iso", size=(360, 360), out=self.picture)
        printed(view.run)
        with Image.open(self.picture) as picture:
            colours = picture.convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE, colors=64)
        colours.save(self.picture, optimize=True)

    def compile(self) -> None:
        """Write the document, with the largest ball that fits into the hand, and `tgdsl compile` it."""
        why = ""
        for radius in RADII:
            self.document.write_text(json.dumps(self._document(radius), indent=1))  # JSON is YAML
            printed(Compile(self.document, out=self.artefact).run)
            closing = closing_of(load(self.artefact))
            if not isinstance(closing, str):
                self.closing = closing
                return
            why = closing
            if "does not fit" not in why:  # then no other ball will
                break
        raise TgdslError(f"the hand closes on no ball of {1e3 * min(RADII):g} to {1e3 * max(RADII):g} mm: {why}")

    def explain(self) -> None:
        """`tgdsl explain`; what it says of taxels that feel nothing is kept."""
        text = printed(Explain(self.artefact).run)
        self.row.explained = [line.strip() for line in text.splitlines() if re.search("buried|deaf|feel nothing|never", line)]

    def run_scene(self) -> None:
        """`tgdsl run`: the hand opens and closes on the ball."""
        printed(Run(self.artefact, seconds=SECONDS, substeps=SUBSTEPS, out=self.folder).run)

    def compare(self) -> None:
        """Compare readings with MuJoCo's own."""
        touch = load(self.artefact, dtype="float64")
        sim = BatchSimulation(touch, 1, keyframe=START, prepare=self.closing.prepare)
        control = controls_between(self.closing.targets(sim.model.nu), SECONDS, sim.control_step)
        self.row.felt = asdict(check(touch, sim, control, INSTANTS))
        wrong = [f"{what} by {self.row.felt[what]:.1e}" for what in ("depth", "force") if not self.row.felt[what] <= LIMIT]
        if wrong:
            raise TgdslError(f"readings differ from MuJoCo's: {', '.join(wrong)}")
        if not self.row.felt["links"]:
            raise TgdslError("the hand does not reach the ball")

    def usd(self) -> None:
        """`tgdsl export-usd` and `tgdsl import`: the robot must come back as it was."""
        stage, back = self.folder / "robot.usda", self.folder / "back.xml"
        printed(ExportUsd(str(self.file), stage).run)
        printed(Import(stage, back).run)
        self.row.usd = difference(load_model(self.file).compiled, load_model(back).compiled)

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
    """Return in what two robots differ: counts, mass, and where their bodies of the same name are at the start."""
    parts = []
    for name in ("nbody", "njnt", "ngeom", "nu", "neq", "ntendon"):
        if getattr(one, name) != getattr(two, name):
            parts.append(f"{name} {getattr(one, name)} → {getattr(two, name)}")
    if abs(one.body_mass.sum() - two.body_mass.sum()) > 1e-6:
        parts.append(f"mass {one.body_mass.sum():.4g} → {two.body_mass.sum():.4g} kg")
    places = []
    for model in (one, two):
        state = mujoco.MjData(model)
        mujoco.mj_kinematics(model, state)
        places.append({model.body(i).name: state.xpos[i] for i in range(model.nbody)})
    common = places[0].keys() & places[1].keys() - {""}
    if lost := sorted(places[0].keys() - common - {""}):
        parts.append(f"without {', '.join(lost)}")
    if common and (off := max(float(np.abs(places[0][n] - places[1][n]).max()) for n in common)) > 1e-6:
        parts.append(f"bodies off by {1e3 * off:.2g} mm")
    return ", ".join(parts)


def printed(command: Callable[[], None]) -> str:
    """Run a command and return what it prints."""
    text = StringIO()
    with redirect_stdout(text):
        command()
    return text.getvalue()


@contextmanager
def overheard(said: list[str]) -> Iterator[None]:
    """Collect warnings, and what is written to standard output and error past Python."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as file, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for number in (1, 2):
            os.dup2(file.fileno(), number)
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for own, number in zip(kept, (1, 2), strict=True):
                os.dup2(own, number)
                os.close(own)
            file.seek(0)
            said += [f"(raw) {line.strip()}" for line in file.read().decode(errors="replace").splitlines() if line.strip()]
            said += [f"{entry.category.__name__}: {entry.message}" for entry in caught]


def printed_row(row: Row, hand: Hand) -> list[str]:
    """Return a row's lines."""
    counts = " ".join(f"{row.taxels.get(name, 0):>6}" for name in FACTORS)
    groups = " ".join(f"{name} {count}" for name, count in row.groups.items())
    felt = "".join(
        f"; {row.felt['links']} links, {row.felt['taxels']} taxels, {row.felt['newtons']:.2f} N; "
        f"errors {row.felt['depth']:.0e} m, {row.felt['force']:.0e} N"
        for _ in range(bool(row.felt))
    )
    lines = [f"{row.name:<14}{row.joints:>4} joints {row.links:>3} links ({row.facing} facing) {counts}  {groups}"]
    lines.append(
        f"    {hand.package} {row.version}; {100 * row.outside:.0f} % outside `hand`{felt}; USD: {row.usd or 'the same'}"
    )
    lines.append("    " + ", ".join(f"{stage} {seconds:g} s" for stage, seconds in row.seconds.items()))
    lines += [f"    explain: {line}" for line in row.explained]
    shown = [text[:400] for text in row.warnings]
    lines += [f"    warned: {text}" for text in shown[:12]]
    lines += [f"    and {len(shown) - 12} more" for _ in range(len(shown) > 12)]
    return lines + [f"    FAILED in {line}" for line in row.error.splitlines()]


def main() -> int:
    """Print the table; return how many hands failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(HANDS)}; default: all")
    parser.add_argument("--out", type=Path, default=Path("out/hands"), help="folder for the stages' files")
    parser.add_argument("--pictures", type=Path, help="folder for the pictures; default: that of the hand's other files")
    parser.add_argument("--timeout", type=float, default=600.0, help="for one hand [s]")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in HANDS]:
        parser.error(f"there is no hand {', '.join(unknown)}; expected some of {', '.join(HANDS)}")
    failed = 0
    for name in options.names or HANDS:
        place = found(HANDS[name])
        if place is None:
            print(f"{name:<14} skipped: {HANDS[name].package} with {HANDS[name].file} is not installed", flush=True)
            continue
        if options.child:
            Line(name, *place, options.out, options.pictures).run()
            continue
        row = in_own_process(name, place[1], options)
        failed += bool(row.error)
        print("\n".join(printed_row(row, HANDS[name])), flush=True)
    return failed


def in_own_process(name: str, version: str, options: argparse.Namespace) -> Row:
    """Return a hand's row, made in a process of its own: what crashes or hangs costs the rest of one row."""
    file = options.out / name / "row.json"
    file.unlink(missing_ok=True)
    command = [sys.executable, __file__, name, "--child", "--out", str(options.out)]
    command += ["--pictures", str(options.pictures)] if options.pictures else []
    why = ""
    try:
        ended = subprocess.run(command, timeout=options.timeout, capture_output=True, text=True)
        if ended.returncode:
            why = f"exit code {ended.returncode}: {ended.stderr.strip()[-300:]}"
    except subprocess.TimeoutExpired:
        why = f"not done after {options.timeout:g} s"
    row = Row(**json.loads(file.read_text())) if file.is_file() else Row(name, version)
    row.error += why
    return row


if __name__ == "__main__":
    sys.exit(main())
