"""A plan's first sensor by its kind's float64 reference, and what it means that a module agrees with it.

Shapes: `env` environments, `taxel` taxels, `row` taxels or bodies, `channel` numbers per row.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates
from torch import Tensor

from tgdsl.module.state import SceneState
from tgdsl.plan.plan import SLOT_FIELDS, Plan, PlannedMoments, PlannedObject
from tgdsl.quantities.reference import (
    ReferenceBody,
    ReferenceContacts,
    ReferenceGeom,
    ReferenceMoments,
    ReferencePoints,
    Touch,
    distance_to,
    touch,
)
from tgdsl.sensors.base import Kind, ProbeSpec

TIE_SHIFT = 1e-7
"""Shift of an object [m] that covers float32 rounding: on which side of a tie a reading falls is not defined closer."""


class ReferenceModule:
    """A plan's first sensor, computed by the kind's float64 reference, environment by environment."""

    def __init__(self, plan: Plan, kind: Kind, spec: ProbeSpec):
        self.plan = plan
        self.kind = kind
        self.spec = spec
        self.sensor = plan.sensors[0]
        self.layout = plan.layout_of(self.sensor)
        reach = plan.arrays[f"queries/{self.sensor.query}/{self.sensor.answer}/reach"][:, slice(*self.sensor.rows)]
        self.radius = reach.max(axis=0, initial=-np.inf)
        self.memory: dict[int, dict[str, np.ndarray]] = {}
        self.tables: dict[tuple[int, int], MomentTable] = {}

    def __call__(self, state: SceneState, shift: np.ndarray) -> tuple[np.ndarray, dict[int, dict[str, np.ndarray]]]:
        """Return readings (env, taxel, channel) of a scene whose objects are shifted [m], and the memory after it."""
        assert state.body_pos is not None
        readings, memories = [], {}
        for env in range(state.body_pos.shape[0]):
            rest = {name: np.full(memory.shape, memory.rest) for name, memory in self.sensor.state.items()}
            felt = self._touch(state, env, shift)
            reading, memories[env] = self.kind.reference(self.spec, self.layout, felt, self.memory.get(env, rest))
            readings.append(reading)
        return np.stack(readings), memories

    def _touch(self, state: SceneState, env: int, shift: np.ndarray) -> Touch:
        inputs, query = self.plan.inputs, self.plan.queries[self.sensor.query]
        answer = query.answers[self.sensor.answer]
        gated = {(pair.link, pair.object): i for i, pair in enumerate(inputs.pairs)}
        parts = []
        for i, link in enumerate(self.layout.links):
            own = self.layout.link_id == i
            objects: list[tuple[ReferenceBody, list[ReferenceGeom]] | None] = []
            for target in (self.plan.objects[query.objects[o]] for o in answer.objects):
                pair = gated.get((link.body, target.name))
                is_found = pair is not None and state.contact_found is not None and state.contact_found[env, pair] > 0
                is_felt = target.body != link.body and (is_found or not answer.is_gated)
                geoms = self._geoms(target, state, env)
                objects.append((self._body(state, env, target.body, shift), geoms) if is_felt else None)
            body = self._body(state, env, link.body, np.zeros(3))
            parts.append(touch(body, self.layout.pos[own], self.radius[own], objects))
        names = [name for name in Touch.__dataclass_fields__ if name not in ("contacts", "moments", "points")]
        contacts = self._contacts(state, env) if "contacts" in answer.needs else None
        joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        points = self._points(state, env, shift)
        return Touch(**joined, contacts=contacts, moments=self._moments(state, env, shift), points=points)

    def _points(self, state: SceneState, env: int, shift: np.ndarray) -> tuple[ReferencePoints, ...]:
        """Return the points of objects where they may meet links, by way of the world frame and one at a time."""
        planned, skin = self.plan.queries[self.sensor.query].answers[self.sensor.answer].points, self.plan.skin
        if planned is None or skin is None:
            return ()
        own = {link.name: (i, link.body) for i, link in enumerate(self.layout.links)}
        found = []
        for o, links in zip(planned.objects, planned.links, strict=True):
            target = self.plan.objects[o]
            body, variant = self._body(state, env, target.body, shift), self._variant(target, state, env)
            table = f"objects/{target.name}/points/{planned.num_points}"
            world = self.plan.arrays[f"{table}/points"][:, variant].T @ body.rotation.T + body.pos
            area = float(self.plan.arrays[f"{table}/area"][variant])
            for row in links:
                i, name = own[skin.links[row]]
                link, geoms = self._body(state, env, name, np.zeros(3)), self._placed("links", skin.shapes, row)
                pos = (world - link.pos) @ link.rotation
                phi, gradient = (np.array(part) for part in zip(*(distance_to(geoms, z) for z in pos), strict=True))
                if not self._is_felt(state, env, name, target.name):
                    phi = np.full(len(pos), np.inf)
                found.append(ReferencePoints(np.flatnonzero(self.layout.link_id == i), pos, phi, gradient, area))
        return tuple(found)

    def _is_felt(self, state: SceneState, env: int, link: str, target: str) -> bool:
        """Return whether the gate of a pair is open."""
        if not self.plan.queries[self.sensor.query].answers[self.sensor.answer].is_gated:
            return True
        pairs = [(pair.link, pair.object) for pair in self.plan.inputs.pairs]
        return state.contact_found is not None and bool(state.contact_found[env, pairs.index((link, target))] > 0)

    def _moments(self, state: SceneState, env: int, shift: np.ndarray) -> ReferenceMoments | None:
        """Return the moments of the objects that the sensor feels, in the world frame, from the plan's own tables."""
        planned = self.plan.queries[self.sensor.query].answers[self.sensor.answer].moments
        if planned is None:
            return None
        layout, num = self.layout, len(planned.objects)
        mass, (first, velocity, angular) = np.zeros((layout.num_taxels, num)), np.zeros((3, layout.num_taxels, num, 3))
        turn, area = np.zeros((layout.num_taxels, 3)), np.zeros(num)
        for k, target in enumerate(self.plan.objects[o] for o in planned.objects):
            variant = self._variant(target, state, env)
            table = self.tables.setdefault(
                (k, variant), MomentTable(self.plan, target.name, planned, variant, planned.radii[k])
            )
            area[k], body = table.area, self._body(state, env, target.body, shift)
            for t, link_id in enumerate(layout.link_id):
                name = layout.links[link_id].body
                if layout.radius[t] <= 0 or name == target.body:
                    continue
                link = self._body(state, env, name, np.zeros(3))
                q = link.pos + link.rotation @ layout.pos[t]
                mass[t, k], about_q = table.at(body.rotation.T @ (q - body.pos), float(layout.radius[t]))
                first[t, k] = link.rotation.T @ body.rotation @ about_q
                velocity[t, k] = link.rotation.T @ (body.velocity_at(q) - link.velocity_at(q))
                angular[t, k] = link.rotation.T @ (body.angvel - link.angvel)
                turn[t] = link.rotation.T @ link.angvel
        return ReferenceMoments(mass, first, velocity, angular, turn, area)

    def _contacts(self, state: SceneState, env: int) -> ReferenceContacts:
        """Return the contacts of the sensor's bodies with the objects that it feels, pair by pair and slot by slot."""
        inputs, sensor = self.plan.inputs, self.sensor
        table = self.plan.arrays[f"queries/{sensor.query}/{sensor.answer}/contacts"]
        rows: list[tuple[int, list[np.ndarray]]] = []
        net = np.zeros((len(self.layout.bodies), 3))
        for b, name in enumerate(self.layout.bodies):
            body = self._body(state, env, name, np.zeros(3))
            for p in (p for p in table[b].tolist() if p < len(inputs.pairs)):
                net[b] += body.rotation.T @ _row(state.contact_netforce, env, p)
                own = [[_row(getattr(state, field), env, p, slot) for field in SLOT_FIELDS] for slot in range(inputs.slots)]
                for pos, *vectors in _completed([row for row in own if np.any(row[1:])], _row(state.contact_netforce, env, p)):
                    rows.append((b, [body.rotation.T @ vector for vector in (pos - body.pos, *vectors)]))
        pos, force, torque, normal = np.array([row for _, row in rows]).reshape(len(rows), 4, 3).transpose(1, 0, 2)
        return ReferenceContacts(np.array([b for b, _ in rows], dtype=np.int64), pos, force, torque, normal, net)

    def _body(self, state: SceneState, env: int, name: str, shift: np.ndarray) -> ReferenceBody:
        i = self.plan.inputs.bodies.index(name)
        fields = ("body_pos", "body_quat", "body_linvel", "body_angvel")
        pos, quat, linvel, angvel = (
            np.zeros(3) if getattr(state, field) is None else getattr(state, field)[env, i].double().numpy() for field in fields
        )
        return ReferenceBody(pos + shift, quat, linvel, angvel)

    def _variant(self, target: PlannedObject, state: SceneState, env: int) -> int:
        if target.num_variants == 1 or state.variant is None:
            return 0
        return int(state.variant[env, self.plan.inputs.objects.index(target.name)])

    def _geoms(self, target: PlannedObject, state: SceneState, env: int) -> list[ReferenceGeom]:
        geoms = self._placed(f"objects/{target.name}", target.shapes, self._variant(target, state, env))
        if target.is_sized and state.object_size is not None:
            size = state.object_size[env, self.plan.inputs.objects.index(target.name)].double().numpy()
            geoms = [dataclasses.replace(geom, size=size) for geom in geoms]
        return geoms

    def _placed(self, path: str, shapes: tuple[str, ...], variant: int) -> list[ReferenceGeom]:
        size, pos, rotation = (self.plan.arrays[f"{path}/{key}"][variant] for key in ("size", "pos", "rotation"))
        absent = self.plan.arrays.get(f"{path}/is_absent", np.zeros((variant + 1, len(size))))[variant]
        present = [g for g in range(len(size)) if not absent[g]]
        return [ReferenceGeom(shapes[g], size[g], pos[g], rotation[g].reshape(3, 3)) for g in present]


def _splines(factors: np.ndarray, place: np.ndarray) -> float:
    """Return a sum of quadratic B-splines about nodes at a place in cells, clamped to half a cell within the border."""
    place = np.clip(place, 0.5, np.array(factors.shape) - 1.5)
    return float(map_coordinates(factors, place[:, None], order=2, prefilter=False, mode="nearest")[0])


class MomentTable:
    """One object's moments by other means than the module's: SciPy's interpolation, a sum over all points, closed form."""

    def __init__(self, plan: Plan, name: str, planned: PlannedMoments, variant: int, radii: tuple[float, ...]):
        """Find the tables of a variant of an object."""
        prefix, self.is_smooth = f"objects/{name}/moments/{planned.request}/", planned.is_smooth
        self.arrays = {path.removeprefix(prefix): value for path, value in plan.arrays.items() if path.startswith(prefix)}
        self.variant, self.radii = variant, radii
        self.area = float(self.arrays["area"][variant])
        self.fields: dict[float, Callable[[np.ndarray], np.ndarray]] = {}

    def at(self, point: np.ndarray, radius: float) -> tuple[float, np.ndarray]:
        """Return S0 [m³] and S1 [m⁴] at a point in the object's frame [m]."""
        total = np.zeros(4)
        if "values" in self.arrays:
            if radius not in self.fields:
                self.fields[radius] = self._field(self.variant * len(self.radii) + self.radii.index(radius))
            total += self.fields[radius](point)[0]
        elif "lists" in self.arrays:
            total += self._summed(point, radius)
        for pos, rotation in zip(self.arrays["plane_pos"], self.arrays["plane_rotation"], strict=True):
            normal = rotation.reshape(3, 3)[:, 2]
            height = float(normal @ (point - pos))
            d = min(abs(height), radius)
            s0 = 2 * np.pi * (radius**3 / 6 - radius * d**2 / 2 + d**3 / 3)
            total += [s0, *(-height * normal * s0)] if d < radius else np.zeros(4)
        return float(total[0]), total[1:]

    def _field(self, i: int) -> Callable[[np.ndarray], np.ndarray]:
        first, num, origin, cell = (self.arrays[name][i] for name in ("first", "num", "origin", "cell"))
        values = self.arrays["values"][first : first + num.prod()].reshape(*num, 4).astype(np.float64)
        if self.is_smooth:
            return lambda point: np.array([_splines(part, (point - origin) / cell) for part in np.moveaxis(values, 3, 0)])[None]
        axes = [start + cell * np.arange(count) for start, count in zip(origin, num, strict=True)]
        return RegularGridInterpolator(axes, values, bounds_error=False, fill_value=0.0)

    @cached_property
    def _points(self) -> np.ndarray:
        lists, first = self.arrays["lists"], self.arrays["first"]
        end = first[self.variant + 1] if self.variant + 1 < len(first) else len(lists)
        rows, filler = np.unique(lists[first[self.variant] : end]), self.arrays["points"].shape[1] - 1
        return self.arrays["points"].T[rows[rows != filler]]

    def _summed(self, point: np.ndarray, radius: float) -> np.ndarray:
        way = self._points - point
        weight = np.maximum(radius - np.linalg.norm(way, axis=1), 0.0) * self.area / len(way)
        return np.array([weight.sum(), *(weight @ way)])


def _completed(contacts: list[list[np.ndarray]], whole: np.ndarray) -> list[list[np.ndarray]]:
    """Return a pair's contacts (place, force, torque, normal), what they lack of its whole force added by shares of force."""
    sizes = [float(np.linalg.norm(force)) for _, force, _, _ in contacts]
    sizes = sizes if sum(sizes) > 0 else [1.0] * len(contacts)
    lacking = whole - sum((force for _, force, _, _ in contacts), np.zeros(3))
    return [
        [pos, force + size / sum(sizes) * lacking, torque, normal]
        for size, (pos, force, torque, normal) in zip(sizes, contacts, strict=True)
    ]


def _row(field: Tensor | None, *index: int) -> np.ndarray:
    assert field is not None
    return field[index].double().numpy()


def full_scale_error(found: Tensor, expected: np.ndarray) -> np.ndarray:
    """Return |found − expected| over the largest magnitude of each channel in the batch (env, row, channel)."""
    scale = np.abs(expected).max(axis=(0, 1), keepdims=True)
    error = np.abs(found.detach().double().numpy() - expected)
    return error / np.where(scale > 0, scale, 1.0)


def assert_agrees(found: Tensor, reference: ReferenceModule, state: SceneState, tolerance: float) -> None:
    """Assert that readings equal the reference's, at ties that of one side; the reference then remembers this state."""
    shifts = [np.zeros(3)] + [sign * TIE_SHIFT * axis for axis in np.eye(3) for sign in (1, -1)]
    worst = np.full(tuple(found.shape[:2]), np.inf)
    memory = None
    for shift in shifts:
        expected, after = reference(state, shift)
        memory = memory or after
        worst = np.minimum(worst, full_scale_error(found, expected).max(axis=2))
        if worst.max() <= tolerance:
            break
    reference.memory = memory or {}
    env, taxel = np.unravel_index(int(worst.argmax()), worst.shape)
    assert worst.max() <= tolerance, f"error {worst.max():.2e} of full scale in environment {env}, row {taxel}"
