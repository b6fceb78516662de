"""Is a robot that an independent converter has written as USD still the same robot? Counts, parameters, contacts, forces.

`mujoco-usd-converter` (PyPI; in an environment of its own, it brings its own USD) writes USD of an MJCF file, tgdsl reads it:

    python benchmarks/converter_twins.py hand.xml hand.usda           # USD that is there
    python benchmarks/converter_twins.py hand.xml --converter PATH    # or let the converter write it

It prints one line for each quantity: the largest difference, and where. Depths are compared at random states to 1e-6 m and
forces to 1 %; over 500 steps from the first state, with controls that swing slowly, mean forces to 2 %.

USD keeps most numbers in float32. Where boxes touch along a face, or two corners are equally deep, that rounding decides which
contacts there are. A state, or the run, that is beyond its limits is marginal if copies of the MJCF model itself, with poses,
sizes and inertias moved within the rounding of float32, differ from it at least half as much: it is left out, and counted.

What MJCF says and the converter does not write is a difference, too. `--losses` takes that out of the MJCF model before it is
compared, so that only what tgdsl reads is left, and names it: collision masks, contact pairs, equalities of tendons, damping
of free joints (mujoco-usd-converter 0.8). Files of meshes that an attached model brings are named from the root, which the
converter cannot find otherwise.
"""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import tyro
from marginal import apart, contacts, contacts_at, is_marginal, ordered

from tgdsl.compiler.pipeline import placed
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.text import new_draft, write_layout

DEPTH, FORCE, MEAN = 1e-6, 0.01, 0.02
"""Limits: depth [m], relative force at a state, relative mean force of a run."""
PLACE, ROWS = 1e-6, 0.99
"""Distance [m] up to which two taxels are at the same place, and the share of those that must be."""
SAME = 1e-5
"""Relative difference of parameters, most of which USD keeps in float32."""
STATES, STEPS = 200, 500
JOINT = ("jnt_type", "jnt_range", "jnt_limited", "jnt_stiffness", "jnt_margin", "jnt_solref", "jnt_solimp", "jnt_actfrcrange")
DOF = ("dof_damping", "dof_armature", "dof_frictionloss", "dof_solref", "dof_solimp")
GEOM = ("geom_type", "geom_condim", "geom_friction", "geom_solref", "geom_solimp", "geom_solmix", "geom_priority")
ACTUATOR = ("dyntype", "gaintype", "biastype", "dynprm", "gainprm", "biasprm", "ctrllimited", "ctrlrange", "forcelimited")
OPTION = ("timestep", "integrator", "cone", "solver", "impratio", "iterations", "gravity", "disableflags", "enableflags")


@dataclass(frozen=True, eq=False)
class Twins:
    """Two models, and which element of the second is which of the first.

    Attributes:
        one: From MJCF.
        two: From USD.
        bodies: Of each body, the index in the second.
        joints: The same of each joint.
        geoms: The same of each geom that collides.
    """

    one: mujoco.MjModel
    two: mujoco.MjModel
    bodies: dict[int, int]
    joints: dict[int, int]
    geoms: dict[int, int]


@dataclass(frozen=True)
class Compare:
    """Compare a robot in MJCF with what a converter made of it.

    Attributes:
        mjcf: The robot or scene.
        usd: Its USD; without it, the converter is run.
        converter: The converter's command.
        losses: Leave out what the converter does not write.
        seed: Of the random states.
    """

    mjcf: Annotated[Path, tyro.conf.Positional]
    usd: Annotated[Path | None, tyro.conf.Positional] = None
    converter: str = "mujoco_usd_converter"
    losses: bool = False
    seed: int = 0


def plain(name: str) -> str:
    """Return a name as a prim can have it."""
    return re.sub(r"\W", "_", name)


def matched(first: list[str], second: list[str]) -> dict[int, int]:
    """Match names as prims have them; what has no name of its own, in order."""
    names = [plain(name) for name in first]
    found = {i: second.index(name) for i, name in enumerate(names) if name and second.count(name) == 1 == names.count(name)}
    left = [i for i in range(len(second)) if i not in found.values()]
    rest = [i for i in range(len(first)) if i not in found]
    return found | dict(zip(rest, left, strict=False))


def colliding(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the geoms of a body that collide."""
    return [int(i) for i in np.flatnonzero((model.geom_bodyid == body) & ((model.geom_contype | model.geom_conaffinity) != 0))]


def twins_of(one: mujoco.MjModel, two: mujoco.MjModel) -> Twins:
    """Match bodies by name, their joints and colliding geoms in order."""
    names = [[model.body(i).name for i in range(model.nbody)] for model in (one, two)]
    bodies, joints, geoms = matched(*names), {}, {}
    for first, second in bodies.items():
        own = [range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]) for m, b in ((one, first), (two, second))]
        joints |= dict(zip(*own, strict=False))
        geoms |= dict(zip(colliding(one, first), colliding(two, second), strict=False))
    return Twins(one, two, bodies, joints, geoms)


def pairs(model: mujoco.MjModel) -> set[tuple[int, int]]:
    """Return the pairs of bodies that can collide, by MuJoCo's own filters."""
    excluded = {(s >> 16, s & 0xFFFF) for s in model.exclude_signature.tolist()}
    is_parent_free = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    weld, parent = model.body_weldid, model.body_weldid[model.body_parentid[model.body_weldid]]
    found = set()
    masks = {
        b: [(int(model.geom_contype[g]), int(model.geom_conaffinity[g])) for g in colliding(model, b)]
        for b in range(model.nbody)
    }
    for a in range(model.nbody):
        for b in range(a + 1, model.nbody):
            is_family = weld[a] and weld[b] and (parent[a] == weld[b] or parent[b] == weld[a])
            if weld[a] == weld[b] or (a, b) in excluded or (is_family and not is_parent_free):
                continue
            if any(c & f or d & e for c, d in masks[a] for e, f in masks[b]):
                found.add((a, b))
    return found


def differences(twins: Twins) -> Iterator[tuple[str, str, bool]]:
    """Yield each quantity, what it is in both models, and whether it is the same."""
    one, two = twins.one, twins.two
    for name in ("nbody", "njnt", "nv", "nu", "neq", "ntendon", "nsite"):
        yield name, f"{getattr(one, name)} {getattr(two, name)}", getattr(one, name) == getattr(two, name)
    counts = [sum(len(colliding(m, b)) for b in range(m.nbody)) for m in (one, two)]
    yield "colliding geoms", f"{counts[0]} {counts[1]}", counts[0] == counts[1]
    first = {tuple(sorted((twins.bodies.get(a, -1), twins.bodies.get(b, -1)))) for a, b in pairs(one)}
    second = pairs(two)
    yield "colliding pairs of bodies", f"{len(first)} {len(second)}, {len(first ^ second)} differ", first == second
    for name in OPTION:
        yield f"option {name}", *compared(getattr(one.opt, name), getattr(two.opt, name))
    for names, indices, prefix in ((JOINT, twins.joints, ""), (GEOM, twins.geoms, "")):
        for name in names:
            yield name, *compared(*(getattr(m, prefix + name)[i] for m, i in rows(twins, indices)))
    dofs = dof_map(twins)
    for name in DOF:
        yield name, *compared(*(getattr(m, name)[i] for m, i in rows(twins, dofs)))
    for name in (*ACTUATOR, "forcerange", "gear"):
        if one.nu == two.nu:
            yield f"actuator {name}", *compared(getattr(one, f"actuator_{name}"), getattr(two, f"actuator_{name}"))
    yield "body_mass", *compared(*(m.body_mass[i] for m, i in rows(twins, twins.bodies)))
    yield "body_inertia", *compared(*(np.sort(m.body_inertia[i], axis=1) for m, i in rows(twins, twins.bodies)))


def rows(twins: Twins, indices: dict[int, int]) -> list[tuple[mujoco.MjModel, list[int]]]:
    return [(twins.one, list(indices.keys())), (twins.two, list(indices.values()))]


def dof_map(twins: Twins) -> dict[int, int]:
    """Return of each degree of freedom its index in the second model."""
    width = {0: 6, 1: 3, 2: 1, 3: 1}
    found = {}
    for a, b in twins.joints.items():
        start, other = int(twins.one.jnt_dofadr[a]), int(twins.two.jnt_dofadr[b])
        found |= {start + i: other + i for i in range(width[int(twins.one.jnt_type[a])])}
    return found


def qpos_map(twins: Twins) -> dict[int, int]:
    """Return of each coordinate its index in the second model."""
    width = {0: 7, 1: 4, 2: 1, 3: 1}
    found = {}
    for a, b in twins.joints.items():
        start, other = int(twins.one.jnt_qposadr[a]), int(twins.two.jnt_qposadr[b])
        found |= {start + i: other + i for i in range(width[int(twins.one.jnt_type[a])])}
    return found


def compared(first: object, second: object) -> tuple[str, bool]:
    """Return the largest difference of two arrays, relative to the larger, and whether they are the same to `SAME`."""
    a, b = np.atleast_1d(np.asarray(first, dtype=float)), np.atleast_1d(np.asarray(second, dtype=float))
    if a.shape != b.shape:
        return f"shapes {a.shape} {b.shape}", False
    if not a.size:
        return "none", True
    scale = np.maximum(np.maximum(np.abs(a), np.abs(b)), 1e-9)
    off = float((np.abs(a - b) / scale).max())
    return f"{off:.1e}", off <= SAME


def random_qpos(model: mujoco.MjModel, generator: np.random.Generator) -> np.ndarray:
    """Return a state with all limited joints somewhere in their range, and the others where they start."""
    qpos = model.qpos0.copy()
    for joint in range(model.njnt):
        if model.jnt_limited[joint] and model.jnt_type[joint] in (2, 3):
            qpos[model.jnt_qposadr[joint]] = generator.uniform(*model.jnt_range[joint])
    return qpos


def at_states(twins: Twins, seed: int) -> Iterator[tuple[str, str, bool]]:
    """Yield how contacts differ at random states."""
    generator, coordinates = np.random.default_rng(seed), qpos_map(twins)
    limits, found, marginal = np.array([DEPTH, FORCE]), [np.zeros((0, 2))], 0
    for _ in range(STATES):
        qpos, other = random_qpos(twins.one, generator), twins.two.qpos0.copy()
        other[list(coordinates.values())] = qpos[list(coordinates.keys())]
        own = contacts_at(twins.one, qpos)
        first = {ordered(twins.bodies[i], twins.bodies[j]): value for (i, j), value in own.items()}
        off = apart(first, contacts_at(twins.two, other))
        worst = off.max(axis=0, initial=0.0)

        def measured(rounded: mujoco.MjModel, qpos: np.ndarray = qpos, own: dict = own) -> np.ndarray:
            return apart(own, contacts_at(rounded, qpos)).max(axis=0, initial=0.0)

        if (worst > limits).any() and is_marginal(twins.one, worst, limits, measured):
            marginal += 1
        else:
            found.append(off)
    every = np.concatenate(found)
    depth, force = every.max(axis=0, initial=0.0)
    beyond = int((every[:, 1] > FORCE).sum())
    yield "marginal states, left out", f"{marginal} of {STATES}", marginal < STATES
    yield f"depth at {len(every)} contacts of bodies [m]", f"{depth:.1e}", bool(depth <= DEPTH)
    yield "force there, of the largest", f"{force:.1e}, {beyond} of {len(every)} beyond the limit", beyond == 0


def mean_force(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return the mean of all normal forces [N], and of all actuators' forces, over a run with controls that swing slowly."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    low, high = model.actuator_ctrlrange.T
    low, high = np.where(model.actuator_ctrllimited, low, -1.0), np.where(model.actuator_ctrllimited, high, 1.0)
    normal, driven = 0.0, 0.0
    for step in range(STEPS):
        data.ctrl[:] = low + (high - low) * (0.5 - 0.5 * np.cos(2 * np.pi * step / STEPS))
        mujoco.mj_step(model, data)
        normal += sum(force for _, force in contacts(model, data).values())
        driven += float(np.abs(data.actuator_force).sum())
    return np.array([normal, driven]) / STEPS


def over_a_run(twins: Twins) -> Iterator[tuple[str, str, bool]]:
    """Yield how mean forces differ over a run."""
    coordinates = qpos_map(twins)
    qpos = twins.two.qpos0.copy()
    qpos[list(coordinates.values())] = twins.one.qpos0[list(coordinates.keys())]
    first, second = mean_force(twins.one, twins.one.qpos0), mean_force(twins.two, qpos)

    def relative(other: np.ndarray) -> np.ndarray:
        return np.where(np.maximum(first, other) > 1e-6, np.abs(first - other) / np.maximum(first, 1e-9), 0.0)

    def measured(rounded: mujoco.MjModel) -> np.ndarray:
        return relative(mean_force(rounded, rounded.qpos0))

    off, limits = relative(second), np.full(2, MEAN)
    is_left_out = bool((off > MEAN).any()) and is_marginal(twins.one, off, limits, measured)
    for name, a, b, share in zip(("normal force", "actuators' force"), first, second, off, strict=True):
        note = ", marginal" if is_left_out and share > MEAN else ""
        yield f"mean {name} over {STEPS} steps", f"{a:.4f} {b:.4f}, {share:.1e}{note}", is_left_out or share <= MEAN


def taxels(mjcf: Path, usd: Path, folder: Path) -> Iterator[tuple[str, str, bool]]:
    """Yield how many rows of taxels are at the same place: of a layout proposed for the first, sampled on both."""
    layout = folder / "layout.yaml"
    write_layout(new_draft(load_model(mjcf), "4/cm2", True, layout, True), layout)
    rows = []
    for robot in (mjcf, usd):
        found = placed({"tgdsl": 1, "robot": {"model": str(robot), "layout": str(layout)}}, resolutions=["med"]).layouts["med"]
        names = [plain(link.name) for link in found.links]
        rows.append({name: found.pos[found.link_id == i] for i, name in enumerate(names)})
    first, second = rows
    same = sum(
        int((np.linalg.norm(a - b, axis=1) <= PLACE).sum())
        for name in first.keys() & second.keys()
        for a, b in [(first[name][: len(second[name])], second[name][: len(first[name])])]
    )
    total = max(sum(map(len, own.values())) for own in rows)
    yield f"taxels of {total} within {PLACE * 1e6:g} µm", f"{same / total:.1%}", same / total >= ROWS


def without_losses(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return a model without what the converter does not write; print what that is."""
    colliding = [geom for geom in spec.geoms if geom.contype or geom.conaffinity]
    masked = [geom for geom in colliding if (geom.contype, geom.conaffinity) != (1, 1)]
    for geom in masked:
        geom.contype, geom.conaffinity = 1, 1
    tendons = [equality for equality in spec.equalities if equality.type == mujoco.mjtEq.mjEQ_TENDON]
    damped = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE and (j.damping.any() or j.armature)]
    for joint in damped:
        joint.damping, joint.armature = 0.0 * joint.damping, 0.0
    lost = {
        "collision masks": masked,
        "contact pairs": spec.pairs,
        "equalities of tendons": tendons,
        "damped free joints": damped,
    }
    print(
        "not written by the converter:",
        ", ".join(f"{len(what)} {name}" for name, what in lost.items() if len(what)) or "nothing",
    )
    for gone in (*spec.pairs, *tendons):
        spec.delete(gone)
    return spec.compile()


def with_mesh_paths(mjcf: Path, folder: Path) -> Path:
    """Write an MJCF file whose meshes are named from the root."""
    spec = mujoco.MjSpec.from_file(str(mjcf))
    homes = [mjcf.parent, *((mjcf.parent / name).parent for name in re.findall(r'<model[^>]*file="([^"]+)"', mjcf.read_text()))]
    is_moved = False
    for mesh in spec.meshes:
        if mesh.file and not (mjcf.parent / mesh.compiler.meshdir / mesh.file).exists():
            places = [home / part / mesh.file for home in homes for part in ("", mesh.compiler.meshdir, "assets")]
            mesh.file = str(next(place for place in places if place.exists()).resolve())
            is_moved = True
    if not is_moved:
        return mjcf
    spec.compile()
    count = itertools.count()  # a class of an attached model without a prefix comes back without its name
    text = re.sub(r"(?<=\s)<default>(?=\s*<default )", lambda _: f'<default class="attached_{next(count)}">', spec.to_xml())
    (folder / mjcf.name).write_text(text)
    return folder / mjcf.name


def main(options: Compare) -> int:
    """Print all differences; return how many quantities are off."""
    with tempfile.TemporaryDirectory() as made, warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}")
        usd, folder = options.usd, Path(made)
        if usd is None:
            subprocess.run([options.converter, str(with_mesh_paths(options.mjcf, folder)), str(folder / "usd")], check=True)
            usd = next((folder / "usd").glob("*.usd*"))
        model, two = load_model(options.mjcf), load_model(usd).compiled
        one = without_losses(model.spec) if options.losses else model.compiled
        twins = twins_of(one, two)
        states = (*differences(twins), *at_states(twins, options.seed), *over_a_run(twins))
        wrong = 0
        for name, shown, is_same in (*states, *taxels(options.mjcf, usd, folder)):
            wrong += not is_same
            print(f"{'    ' if is_same else 'OFF '}{name}: {shown}")
    print(f"{options.mjcf.name}: {wrong} quantities differ")
    return wrong


if __name__ == "__main__":
    sys.exit(int(main(tyro.cli(Compare)) > 0))
