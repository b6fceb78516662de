"""A robot's tree of bodies as a table: joints, geoms, surface, mass and link groups."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.errors import Problem, RobotError, SpecError
from tgdsl.formats.model import Model
from tgdsl.schema.load import LoadedLayout, load_layout
from tgdsl.schema.select import select

_HEADER = ("body", "joints", "geoms", "area [cm²]", "mass [g]", "groups")
_NUMBERS = (3, 4)
_JOINTS = ("free", "ball", "slide", "hinge")  # in the order of mjtJoint


def links_table(robot: Model, layout: Path | None = None) -> list[str]:
    """Return the lines of the table: one body after another in depth-first order, children indented.

    Areas are sums over the geoms that can be touched: where these overlap, both count.
    """
    model = robot.compiled
    groups = _groups(robot, load_layout(layout)) if layout else {}
    blocks: list[list[tuple[str, ...]]] = [[(name,) for name in _HEADER]]
    depth = {0: 0}
    for body in range(model.nbody):
        depth[body] = depth[int(model.body_parentid[body])] + 1 if body else 0
        name = robot.body_path(body)
        cells = (
            ("  " * depth[body] + name,),
            _joints(model, body) or ("-" if body else "",),
            _geoms(robot, body) or ("-",),
            (_area(robot, body),),
            (f"{1e3 * model.body_mass[body]:.1f}" if body else "",),
            (", ".join(groups.get(model.body(body).name, ())),),
        )
        blocks.append(list(cells))
    return _aligned(blocks) + _self_contacts(robot)


def _self_contacts(robot: Model) -> list[str]:
    """Return a line for each pair of links that press on each other in the initial pose, the strongest first."""
    model, data = robot.compiled, mujoco.MjData(robot.compiled)
    mujoco.mj_forward(model, data)
    loads: dict[tuple[int, int], float] = defaultdict(float)
    force = np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, force)
        one, two = sorted(model.geom_bodyid[contact.geom].tolist())
        loads[one, two] += float(force[0])
    return [
        f"in the initial pose {robot.body_path(one)} and {robot.body_path(two)} press on each other with {load:.3g} N"
        for (one, two), load in sorted(loads.items(), key=lambda item: -item[1])
        if one and load
    ]


def _aligned(blocks: Sequence[Sequence[tuple[str, ...]]]) -> list[str]:
    """Return blocks of cells, of one or several lines each, as lines with aligned columns."""
    rows = [row for block in blocks for row in zip_longest(*block, fillvalue="")]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        columns = enumerate(zip(row, widths, strict=True))
        lines.append("  ".join(text.rjust(w) if i in _NUMBERS else text.ljust(w) for i, (text, w) in columns).rstrip())
    return lines


def _joints(model: mujoco.MjModel, body: int) -> tuple[str, ...]:
    results = []
    first = int(model.body_jntadr[body])
    for joint in range(first, first + int(model.body_jntnum[body])):
        kind = _JOINTS[int(model.jnt_type[joint])]
        name = model.joint(joint).name
        span = f" {_range(model, joint, kind)}" if kind != "free" else ""
        results.append(f"{name}: {kind}{span}" if name else f"{kind}{span}")
    return tuple(results)


def _range(model: mujoco.MjModel, joint: int, kind: str) -> str:
    if not model.jnt_limited[joint]:
        return "unlimited"
    low, high = (model.jnt_range[joint] * 1e3 if kind == "slide" else np.degrees(model.jnt_range[joint])).tolist()
    unit = "mm" if kind == "slide" else "deg"
    return f"up to {high:.4g} {unit}" if kind == "ball" else f"{low:.4g} to {high:.4g} {unit}"


def _geoms(robot: Model, body: int) -> tuple[str, ...]:
    results = []
    first = int(robot.compiled.body_geomadr[body])
    for geom in map(robot.geom, range(first, first + int(robot.compiled.body_geomnum[body]))):
        kind = f"{geom.shape} {geom.mesh}" if geom.mesh else geom.shape
        results.append(f"{geom.name + ': ' if geom.name else ''}{kind}, {'colliding' if geom.is_colliding else 'visual'}")
    return tuple(results)


def _area(robot: Model, body: int) -> str:
    name = robot.compiled.body(body).name
    geoms = robot.touchable(name) if name else ()
    if not geoms:
        return "-"
    try:
        return f"{1e4 * robot.surface(geoms).face_areas.sum():.2f}"
    except RobotError:
        return "unbounded"


def _groups(robot: Model, layout: LoadedLayout) -> dict[str, list[str]]:
    """Return the groups that each body is in."""
    candidates = [[body, *(n for geom in robot.touchable(body) for n in geom.names)] for body in robot.bodies]
    names = [name for geom in robot.geoms for name in geom.names]
    problems: list[Problem] = []
    result: dict[str, list[str]] = {}
    for group, selection in layout.spec.groups.items():

        def report(where: tuple[str, int], what: str, hint: str, group: str = group) -> None:
            problems.append(layout.problem(("groups", group), what, hint))

        for i in select(selection, candidates, layout.spec.groups, report, group, names):
            result.setdefault(robot.bodies[i], []).append(group)
    if problems:
        raise SpecError(problems)
    return result
