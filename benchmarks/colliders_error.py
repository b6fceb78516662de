"""Errors of primitive colliders, capped iterations and tolerances in C MuJoCo in float64, and pairs of links in contact.

Used by colliders.py. Variants start from the same states with the same targets. They are compared with mesh colliders, 100
iterations and a tolerance of 1e-8, with the same friction cone:

- `mm_1`, `mm_10`, `deg_1`, `deg_10`: error of the object's pose after one and ten control steps, RMS over states;
- `force_%`: RMS error of the forces on links after one control step, over their RMS; states are from mesh colliders, so that
  primitives start with gaps or penetrations up to a millimetre;
- `load_%`: sum of the forces' magnitudes after ten control steps, over the exact one;
- `depth_mm`: mean over states of the deepest penetration after ten control steps;
- `stays_%`: share of the states at whose end the object is still on the palm; `rounds`: mean number of Newton iterations.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import compile_sensors
from tgdsl.scene.scene import Choice, SceneModels

COLLISIONS, CONES = ("mesh", "primitive"), ("pyramidal", "elliptic")
VISIT = 12
"""Control steps until joints get new goals."""
EXACT = {"iterations": 100, "ls_iterations": 50, "tolerance": 1e-8}


@dataclass(frozen=True)
class Variant:
    """Colliders, friction cone, and options of the solver that differ from the scene's."""

    collision: str
    cone: str
    options: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The first columns of the variant's row."""
        options = " ".join(f"{name}={value:g}" for name, value in self.options.items())
        return f"{self.collision:<9} {self.cone:<9} {options or '-':<32}"


class Scenes:
    """The task's scene in C MuJoCo, with each kind of colliders, for each variant of the object."""

    def __init__(self, task: Path):
        """Compile the scene with each kind of colliders."""
        self.scenes, self.names = {}, {}
        for collision in COLLISIONS:
            loaded = load_task(task, {"physics.collision": collision, "touch": "none"})
            sensors = compile_sensors(loaded, "cpu")
            self.scenes[collision], self.spec = sensors.touch.plan.scene, loaded.spec
            self.body = sensors.object
        self._models: dict[tuple[Any, ...], mujoco.MjModel] = {}

    def model(self, variant: Variant, number: int) -> mujoco.MjModel:
        """Return the model of a variant of colliders and options with a variant of the object."""
        key = (variant.collision, variant.cone, *sorted(variant.options.items()), number)
        if key not in self._models:
            options = self.spec.physics.options | EXACT | {"cone": variant.cone} | variant.options
            models = SceneModels(self.scenes[variant.collision], options)
            self._models[key] = models.model({"item": Choice(number)})
        return self._models[key]


@dataclass(frozen=True, eq=False)
class Instant:
    """A state, and the targets of the control steps after it (step, actuator)."""

    number: int
    qpos: np.ndarray
    qvel: np.ndarray
    targets: np.ndarray


def advance(model: mujoco.MjModel, data: mujoco.MjData, target: np.ndarray, substeps: int) -> None:
    """Make a control step."""
    data.ctrl[:] = target
    mujoco.mj_step(model, data, substeps)


def targets(model: mujoco.MjModel, start: np.ndarray, moved: np.ndarray, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Return targets like those of the task's actions: joints move to random goals by at most 0.05 rad per control step."""
    low, high = model.actuator_ctrlrange.T
    result, now, goal = [], start.copy(), start.copy()
    for i in range(steps):
        if i % VISIT == 0:
            goal[moved] = (low + (high - low) * rng.uniform(0.05, 0.95, len(low)))[moved]
        now[moved] += np.clip(goal - now, -0.05, 0.05)[moved]
        result.append(now.copy())
    return np.array(result)


def instants(scenes: Scenes, count: int, ahead: int, seed: int = 0) -> list[Instant]:
    """Return states in which fingers move an object on the palm, with all variants of the object in turn."""
    rng, result = np.random.default_rng(seed), []
    reference = Variant("mesh", "elliptic")
    for i in range(count):
        model = scenes.model(reference, i % 16)
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        moved = np.array([j for j in range(model.nu) if "thumb" in model.actuator(j).name or "_mid" in model.actuator(j).name])
        address = int(model.jnt_qposadr[model.body(scenes.body).jntadr[0]])
        data.qpos[address : address + 2] += rng.uniform(-0.01, 0.01, 2)
        lead = int(rng.integers(10, 50))
        series = targets(model, model.key_ctrl[0], moved, lead + ahead, rng)
        for target in series[:lead]:
            advance(model, data, target, scenes.spec.physics.substeps)
        result.append(Instant(i % 16, data.qpos.copy(), data.qvel.copy(), series[lead:]))
    return result


def link_forces(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Return the force of each body's geoms on the object in the world [N], (body, 3)."""
    forces, wrench = np.zeros((model.nbody, 3)), np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        one, two = (int(model.geom_bodyid[geom]) for geom in contact.geom)
        if body in (one, two):
            mujoco.mj_contactForce(model, data, i, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second geom's body
            forces[one if two == body else two] += force if two == body else -force
    return forces


@dataclass(frozen=True)
class Outcome:
    """The end of a run: the object's positions [m] and orientations after 1 and 10 steps, forces [N], penetration [m]."""

    place: np.ndarray
    turn: np.ndarray
    force: np.ndarray
    load: float
    depth: float
    stays: bool
    rounds: float


def outcome(scenes: Scenes, variant: Variant, instant: Instant) -> Outcome:
    """Run from an instant with a variant."""
    model = scenes.model(variant, instant.number)
    data, body = mujoco.MjData(model), int(model.body(scenes.body).id)
    data.qpos[:], data.qvel[:] = instant.qpos, instant.qvel
    mujoco.mj_forward(model, data)
    start, place, turn, rounds = data.xpos[body].copy(), [], [], []
    force, load, depth = np.zeros((model.nbody, 3)), 0.0, 0.0
    for i, target in enumerate(instant.targets):
        advance(model, data, target, scenes.spec.physics.substeps)
        rounds.append(float(data.solver_niter[: max(data.nisland, 1)].max()))
        if i in (0, 9):
            mujoco.mj_forward(model, data)
            place.append(data.xpos[body].copy())
            turn.append(data.xquat[body].copy())
        if i == 0:
            force = link_forces(model, data, body)
        if i == 9:
            near = [-data.contact[k].dist for k in range(data.ncon) if body in model.geom_bodyid[data.contact[k].geom]]
            depth, load = max([0.0, *near]), float(np.linalg.norm(link_forces(model, data, body), axis=1).sum())
    stays = bool(np.linalg.norm(data.xpos[body] - start) < scenes.spec.drop_distance)  # type: ignore[attr-defined]
    return Outcome(np.array(place), np.array(turn), force, load, depth, stays, statistics.fmean(rounds))


def angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles between orientations [deg]."""
    return np.degrees(2 * np.arccos(np.clip(np.abs((one * other).sum(axis=-1)), 0, 1)))


def compared(outcomes: Sequence[Outcome], exact: Sequence[Outcome]) -> dict[str, float]:
    """Return a row of the table: a variant against the exact one."""
    pairs = list(zip(outcomes, exact, strict=True))
    moved = np.array([np.linalg.norm(a.place - b.place, axis=1) for a, b in pairs])
    turned = np.array([angles(a.turn, b.turn) for a, b in pairs])
    forces, differences = np.array([b.force for _, b in pairs]), np.array([a.force - b.force for a, b in pairs])
    row = {}
    for i, steps in enumerate((1, 10)):
        row[f"mm_{steps}"] = 1e3 * float(np.sqrt((moved[:, i] ** 2).mean()))
        row[f"mm_{steps}_median"] = 1e3 * float(np.median(moved[:, i]))
        row[f"deg_{steps}"] = float(np.sqrt((turned[:, i] ** 2).mean()))
    row["force_%"] = 100.0 * float(np.sqrt((differences**2).sum() / (forces**2).sum()))
    row["load_%"] = 100.0 * sum(a.load for a in outcomes) / sum(b.load for b in exact)
    row["depth_mm"] = 1e3 * statistics.fmean(a.depth for a in outcomes)
    row["stays_%"] = 100.0 * statistics.fmean(a.stays for a in outcomes)
    row["rounds"] = statistics.fmean(a.rounds for a in outcomes)
    return row


COLUMNS = ("mm_1", "mm_10", "mm_10_median", "deg_1", "deg_10", "force_%", "load_%", "depth_mm", "stays_%", "rounds")


def error(options: argparse.Namespace) -> None:
    """Print a row per variant of colliders and options, each against the exact one with the same cone."""
    scenes = Scenes(options.task)
    starts = instants(scenes, options.states, options.ahead)
    print(f"{'variant':<52} {' '.join(f'{name:>12}' for name in COLUMNS)}")
    exact = {cone: [outcome(scenes, Variant("mesh", cone), start) for start in starts] for cone in options.cones}
    for cone in options.cones:
        for collision, solver in itertools.product(options.collisions, options.error_variants):
            variant = Variant(collision, cone, solver)
            row = compared([outcome(scenes, variant, start) for start in starts], exact[cone])
            print(variant.name, " ".join(f"{row[name]:12.3f}" for name in COLUMNS), flush=True)
    if len(options.cones) == 2:
        row = compared(exact["pyramidal"], exact["elliptic"])
        print(f"{'mesh pyramidal against mesh elliptic':<52}", " ".join(f"{row[name]:12.3f}" for name in COLUMNS))


def pairs(options: argparse.Namespace) -> None:
    """Print per kind of colliders the number of pairs of geoms that may meet, and the pairs of bodies in contact in a run."""
    scenes = Scenes(options.task)
    starts = instants(scenes, options.states, options.ahead)
    for collision in options.collisions:
        variant, met, least = Variant(collision, "elliptic"), dict[str, int](), dict[str, float]()
        for start in starts:
            model = scenes.model(variant, start.number)
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = start.qpos, start.qvel
            for target in start.targets:
                advance(model, data, target, scenes.spec.physics.substeps)
                for k in range(data.ncon):
                    bodies = sorted(int(model.geom_bodyid[geom]) for geom in data.contact[k].geom)
                    name = " – ".join(model.body(i).name for i in bodies)
                    met[name] = met.get(name, 0) + 1
                    least[name] = min(least.get(name, 0.0), float(data.contact[k].dist))
        may = candidates(scenes.model(variant, 0))
        print(f"{collision}: {sum(may.values())} pairs of geoms may meet: {may}")
        for name, count in sorted(met.items(), key=lambda item: -item[1]):
            print(f"  {name:<70} {count:7d} contacts, deepest {-1e3 * least[name]:.2f} mm")


def candidates(model: mujoco.MjModel) -> dict[str, int]:
    """Return the number of pairs of geoms that may meet by collision bits, exclusions and the tree of bodies, by kind."""
    counts = {"link – link": 0, "link – object": 0, "world – other": 0}
    excluded = set(model.exclude_signature.tolist())
    for a, b in itertools.combinations(range(model.ngeom), 2):
        one, two = sorted(int(model.geom_bodyid[i]) for i in (a, b))
        bits = model.geom_contype[a] & model.geom_conaffinity[b] | model.geom_contype[b] & model.geom_conaffinity[a]
        welded = model.body_weldid[[one, two]]
        parents = model.body_weldid[model.body_parentid[welded]]
        is_kin = welded[0] and welded[1] and (welded[0] == parents[1] or welded[1] == parents[0])
        if not bits or welded[0] == welded[1] or is_kin or (one << 16) + two in excluded:
            continue
        is_object = [bool(model.body_dofnum[i] == 6) for i in (one, two)]
        kind = "link – object" if any(is_object) and one else "world – other" if not one else "link – link"
        counts[kind] += 1
    return counts
