"""Small scenes of oracles: probes on a body over one object, and a pad that carries a cube.

Shapes: `env` environments, `taxel` taxels, `slot` contacts of a pair.
"""

import functools
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from tgdsl.errors import CoarseCellsWarning, UnfeltWarning
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.plan.plan import Plan
from tgdsl.runtime.connect import simulate
from tgdsl.tuning.compile import compile_plan

BOX = '<geom type="box" size=".02 .02 .02"/>'
BALL = '<geom type="sphere" size=".02"/>'
Point = Sequence[Any]
HERE = "{folder}"


@contextmanager
def folder() -> Iterator[Path]:
    """Yield a temporary folder for a scene's files."""
    with TemporaryDirectory(prefix="tgdsl-") as name:
        yield Path(name)


def temporary(build: Callable[..., Any], *arguments: Any, **fields: Any) -> Any:
    """Return the result of a function whose first argument is a temporary folder."""
    with folder() as where:
        return build(where, *arguments, **fields)


def compiled(document: Mapping[str, Any], dtype: torch.dtype = torch.float64) -> TactileModule:
    """Return a document's module without warnings of unreachable taxels, because poses are made up."""
    model = Path(document["robot"]["model"])
    files = tuple((file.name, file.read_bytes()) for file in sorted(model.parent.iterdir()) if file.is_file())
    text = json.dumps(document, default=lambda value: value.tolist()).replace(str(model.parent), HERE)
    return TactileModule(_plan_of(text, files), dtype=dtype)


@functools.lru_cache(maxsize=64)
def _plan_of(document: str, files: tuple[tuple[str, bytes], ...]) -> Plan:
    """Return the plan of a document as JSON with the files next to its model, in a folder called `HERE`."""
    with folder() as where, warnings.catch_warnings():
        warnings.simplefilter("ignore", UnfeltWarning)
        warnings.simplefilter("ignore", CoarseCellsWarning)  # some cases are about coarse cells
        for name, content in files:
            (where / name).write_bytes(content)
        return compile_plan(json.loads(document.replace(HERE, str(where))))


def points(places: Sequence[Point] | np.ndarray, radius: float, normal: Point = (0, 0, 1)) -> dict[str, Any]:
    """Return a link's layout: probes at these positions [m] with one radius [m] and one normal."""
    rows = [{"pos": [float(part) for part in pos], "normal": list(normal), "radius": radius} for pos in places]
    return {"method": "points", "points": rows}


def module(
    where: Path, probes: Sequence[Point] | np.ndarray, geom: str, *, radius: float = 0.01, dtype: torch.dtype = torch.float64,
    gate: str | None = "geometric", mesh: trimesh.Trimesh | None = None, scale: float = 1.0,
    target: Mapping[str, Any] | None = None, **sensor: Any,
) -> TactileModule:  # fmt: skip
    """Return a module with one sensor, `s`, whose probes [m] are on the body `pad`; the object's geom is MJCF text.

    A `mesh` [m] is a file `item` in units of `scale` metres; `target` are other fields of the object; kinds without a gate
    take None.
    """
    asset = ""
    if mesh is not None:
        mesh.copy().apply_scale(1 / scale).export(where / "item.stl")
        asset = f'<asset><mesh name="item" file="item.stl" scale="{scale} {scale} {scale}" inertia="shell"/></asset>'
    joint = "" if "plane" in geom else "<freejoint/>"  # MuJoCo allows planes only in static bodies
    (where / "scene.xml").write_text(
        f'<mujoco><compiler balanceinertia="true"/>{asset}<worldbody><body name="pad"><freejoint/><geom size=".05"/></body>'
        f'<body name="item">{joint}{geom}</body></worldbody></mujoco>',
        encoding="utf-8",
    )
    sensor = {"links": "pad", "feels": ["item"], **({"gate": gate} if gate else {}), **sensor}
    return compiled(document(where / "scene.xml", "item", sensor, points(probes, radius), **(target or {})), dtype)


def document(
    model: Path, item: str, sensor: Mapping[str, Any], pad: Mapping[str, Any] | None = None, **target: Any
) -> dict[str, Any]:
    """Return a document with one sensor, `s`, that feels one body of a model; `pad` is the layout of the link `pad`."""
    layout = {"layout": {"resolutions": {"r": {"pad": pad}}}} if pad else {}
    robot = {"model": str(model), **layout}
    return {"tgdsl": 1, "robot": robot, "objects": {item: {"body": item, **target}}, "sensors": {"s": sensor}}


def probed(probes: Sequence[Point] | np.ndarray, geom: str, **sensor: Any) -> TactileModule:
    """Return `module` of a temporary scene file."""
    return temporary(module, probes, geom, **sensor)


def state(touch: TactileModule, **item: Any) -> SceneState:
    """Return a state at rest at the origin, except the item's given pos, quat, linvel or angvel."""
    rest = {"pos": [0, 0, 0], "quat": [1, 0, 0, 0], "linvel": [0, 0, 0], "angvel": [0, 0, 0]}
    values: dict[str, Any] = {}
    for name, default in rest.items():
        rows = [item.get(name, default) if body == "item" else default for body in touch.inputs.bodies]
        values[f"body_{name}"] = torch.tensor(np.array([rows], dtype=float))
    if touch.inputs.pairs:
        values["contact_found"] = torch.ones(1, len(touch.inputs.pairs))
    return SceneState(**values)


PAD = """
<mujoco>
  <option timestep="{timestep}" cone="elliptic" impratio="10" gravity="{gravity}"/>
  <worldbody>
    <body name="pad" {mount}><geom name="pad" type="box" size=".06 .06 .01" friction="{friction}"/></body>
    <body name="cube" {place}><freejoint/><geom type="box" size=".02 .02 .02" mass="{mass}" friction="{friction}"/></body>
  </worldbody>
  <keyframe><key name="start" qvel="{qvel}"/></keyframe>
</mujoco>
"""
FOOTPRINT = 0.015
"""Radius of a footprint [m]: half of it spans from the middle of a cell of the pad to its taxels."""
LINE = np.linspace(-0.025, 0.025, 6)
TAXELS = [(float(x), float(y), 0.01) for x in LINE for y in LINE]
"""Positions of the pad's taxels [m]."""


def pad(
    where: Path, taxels: Sequence[Point] = TAXELS, mass: float = 0.25, place: str = "pos='0 0 .03'", mount: str = "",
    friction: float = 1.0, qvel: str = "0 0 0 0 0 0", timestep: float = 0.002, dtype: torch.dtype = torch.float64,
    gravity: str = "0 0 -9.81", **sensor: Any,
) -> TactileModule:  # fmt: skip
    """Return a module with one sensor, `s`, whose taxels lie on top of a pad of 12 cm that carries a cube of 4 cm.

    They are force taxels, unless another kind is named.
    """
    text = PAD.format(mass=mass, place=place, mount=mount, friction=friction, qvel=qvel, timestep=timestep, gravity=gravity)
    (where / "scene.xml").write_text(text, encoding="utf-8")
    kind = {} if "kind" in sensor else {"kind": "force_taxel", "footprint": FOOTPRINT}
    sensor = {"links": "pad", "feels": ["cube"], **kind, **sensor}
    return compiled(document(where / "scene.xml", "cube", sensor, points(taxels, 0.004)), dtype)


def settled(touch: TactileModule, steps: int = 1500, **options: Any) -> SceneState:
    """Return the scene's state after some physics steps."""
    sim = simulate(touch, 1, substeps=steps, **options)
    sim.step()
    return sim.state()


def resting(**scene: Any) -> tuple[TactileModule, SceneState]:
    """Return the module of a `pad` and its state after the cube has settled."""
    with folder() as where:
        touch = pad(where, **scene)
        return touch, settled(touch)


def in_link(touch: TactileModule, scene: SceneState, vector: np.ndarray) -> np.ndarray:
    """Return world vectors of one environment in the pad's frame."""
    assert scene.body_quat is not None
    quat = scene.body_quat[0, touch.inputs.bodies.index("pad")].numpy()
    return Rotation.from_quat(quat, scalar_first=True).inv().apply(vector)


def wrench(touch: TactileModule, scene: SceneState) -> tuple[np.ndarray, np.ndarray]:
    """Return the solver's force on the pad [N] and its moment about the pad's origin [N·m], in the pad's frame."""
    pos, force, torque, net = scene.contact_pos, scene.contact_force, scene.contact_torque, scene.contact_netforce
    assert scene.body_pos is not None and pos is not None and force is not None and torque is not None and net is not None
    origin = scene.body_pos[0, touch.inputs.bodies.index("pad")].numpy()
    moment = np.cross(pos[0, 0].numpy() - origin, force[0, 0].numpy()) + torque[0, 0].numpy()
    return in_link(touch, scene, net[0, 0].numpy()), in_link(touch, scene, moment.sum(axis=0))
