"""Contacts on pads and on a finger: what tests of their sharing out are given."""

import dataclasses

import numpy as np
import torch

from tgdsl.geometry import planes
from tgdsl.quantities.contacts import ContactPoints
from tgdsl.sensors.force_taxel.footprint import LEVENBERG, Bodies, box, place

RADIUS = 0.01


def pad(num=4):
    line = (np.arange(num) - (num - 1) / 2) * 0.005
    x, y = np.meshgrid(line, line, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), 0.001 * np.cos(300 * x.ravel())])


def tilted(rng, shape, by, up):
    """Return unit vectors up or down (3, *shape), tilted at random."""
    around = by * rng.normal(size=(3, *shape))
    around[2] += up
    return around / np.linalg.norm(around, axis=0)


def grip(rng, num_envs, num_contacts, pads, half=0.012, steps=2):
    """Return the arguments of a case: contacts spread over the pads, some without a force, some taxels inactive.

    Their normals point any way, so that some contacts are on the back of some taxels.
    """
    shape = (num_envs, len(pads), num_contacts)
    point = np.stack([*rng.uniform(-half, half, (2, *shape)), rng.uniform(-0.001, 0.001, shape)])
    force = rng.uniform(0.2, 1.0, shape) * np.stack([*rng.uniform(-0.5, 0.5, (2, *shape)), -np.ones(shape)])
    torque = 2e-4 * rng.normal(size=(3, *shape))
    is_none = rng.random(shape) < 0.3
    normal = tilted(rng, shape, 0.6, -1)
    force[:, is_none] = torque[:, is_none] = normal[:, is_none] = 0
    pos = np.concatenate(pads).T
    is_active = rng.random(pos.shape[1]) < 0.9
    depth = rng.uniform(0, 0.002, (num_envs, pos.shape[1])) * (rng.random((num_envs, pos.shape[1])) < 0.7)
    radius = np.linspace(RADIUS, 1.3 * RADIUS, len(pads))
    counts = np.array([len(each) for each in pads])
    bodies = bodies_of(counts, is_active, pos.T, tilted(rng, pos.shape[1:], 0.3, 1).T)
    return bodies, pos, depth, point, force, torque, normal, radius, np.full(steps, LEVENBERG)


def bodies_of(counts, is_active, pos, outward):
    """Return the padded taxels of bodies with so many each, all of a radius of 2 mm."""
    first = np.concatenate([[0], np.cumsum(counts)])
    rank = np.arange(first[-1]) - np.repeat(first[:-1], counts)
    body = np.repeat(np.arange(len(counts)), counts)
    taxel = np.repeat(first[:-1, None], counts.max(), axis=1)
    inverse_radius = np.zeros(taxel.shape)
    taxel[body, rank] = np.arange(first[-1])
    inverse_radius[body, rank] = is_active / 0.002
    boxes = np.array([box(pos[(body == b) & is_active]) for b in range(len(counts))])
    places = place(pos, outward, is_active)
    padded = np.concatenate([pos.T, -2.0 * outward.T])[:, taxel]
    return Bodies(*map(torch.tensor, (taxel, inverse_radius, body * counts.max() + rank, first, boxes, places, padded)))


def finger(rng, num_envs, num_contacts, steps):
    """Return the arguments of a case: contacts around a finger of 6 mm whose front has taxels, pressing inwards."""
    shape = (num_envs, 1, num_contacts)
    front, around = np.repeat(np.radians([-75, -45, -15, 15, 45, 75]), 3), rng.uniform(-np.pi, np.pi, shape)
    pos = 0.006 * np.array([np.sin(front), np.zeros(18), np.cos(front)]) + [[0], [1], [0]] * np.tile([-0.004, 0, 0.004], 6)
    outward = np.array([np.sin(front), np.zeros(18), np.cos(front)])
    normal = -np.array([np.sin(around), np.zeros(shape), np.cos(around)])
    point = -0.006 * normal + np.array([0, 1, 0])[:, None, None, None] * rng.uniform(-0.005, 0.005, shape)
    force = rng.uniform(0.2, 1.0, shape) * (normal + 0.2 * rng.normal(size=(3, *shape)))
    bodies = bodies_of(np.array([18]), np.ones(18, dtype=bool), pos.T, outward.T)
    depth = rng.uniform(0, 0.002, (num_envs, 18))
    return bodies, pos, depth, point, force, 0 * force, normal, np.array([RADIUS]), np.full(steps, LEVENBERG)


def cases():
    rng = np.random.default_rng(0)
    found = {
        "one environment": grip(rng, 1, 8, [pad(3)], steps=4),
        "several bodies": grip(rng, 9, 3, [pad(3), pad(2)[:3], pad(2)[:1]]),
        "at the edge": grip(rng, 100, 4, [pad()], half=0.03),
        "by depth alone": grip(rng, 3, 2, [pad(3)], steps=0),
        "no contacts": grip(rng, 3, 0, [pad(3)]),
        "all beyond reach": grip(rng, 3, 4, [pad(3) + 1.0]),
        "a row": grip(rng, 5, 4, [pad(5)[2::5]]),
        "around a finger": finger(rng, 12, 4, 4),
        "around a finger, many steps": finger(rng, 6, 2, 13),
        "many steps": grip(rng, 3, 2, [pad(2)], half=0.015, steps=13),
        "no force": grip(rng, 3, 5, [pad(2)], steps=1),
        "not a number": grip(rng, 7, 6, [pad(3), pad(2)], steps=1),
    }
    found["no force"][4][:] = 0
    found["no force"][5][:] = 0
    depth, point, force, torque, normal = found["not a number"][2:7]
    normal[1, 5, 0, 3] = depth[0, 1] = point[0, 2, 0, 1] = point[2, 3, 1, 5] = force[1, 4, 1, 2] = torque[2, 5, 0, 5] = np.nan
    force[:, 2], torque[:, 2] = 0, 0
    force[:, 6], torque[:, 6], depth[6, 10] = 0, 0, np.nan
    return found


def arguments(case, dtype):
    """Return the arguments of `shared_forces` in a dtype."""
    bodies, _, depth, *rest = case
    vectors = [planes.vec(torch.tensor(value, dtype=dtype) for value in part) for part in rest[:4]]
    contacts = ContactPoints(*vectors, net=planes.vec(part.sum(dim=-1) for part in vectors[1]))
    radius, levenberg = (torch.tensor(value, dtype=dtype) for value in rest[4:])
    floats = {name: value.to(dtype) for name, value in vars(bodies).items() if value.is_floating_point()}
    return dataclasses.replace(bodies, **floats), torch.tensor(depth, dtype=dtype), contacts, radius, levenberg
