"""Models whose objects' variants are meshes, all of which have their convex hulls in each model."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco

from tgdsl.errors import SimulationError
from tgdsl.scene.contact_bits import free_bit
from tgdsl.scene.scene import Choice, SceneModels, with_choices

SPARE_BODY = "tgdsl/spare"
"""The body that holds one geom per mesh: it belongs to the world, touches nothing and is not seen."""


class SharedMeshModels(SceneModels):
    """The models of a scene for simulators that share meshes among environments.

    MuJoCo makes the hulls of meshes that some geom collides with. Here a spare body, the last one, holds every mesh of every
    variant, so that meshes and hulls are the same whatever is chosen. Without such meshes the models are those of the scene.
    """

    def _compiled(self, choices: Mapping[str, Choice]) -> mujoco.MjModel:
        plain = super()._compiled(choices)
        spec = with_choices(self._base.copy(), list(self.objects.values()), choices)
        meshes = [mesh.name for mesh in spec.meshes if mesh.name.startswith("tgdsl/")]
        if not meshes:
            return plain
        for target in self.objects.values():
            body, id = spec.body(target.body), plain.body(target.body).id
            body.explicitinertial = True
            body.mass, body.inertia = plain.body_mass[id], plain.body_inertia[id]
            body.iquat, body.ipos = plain.body_iquat[id], plain.body_ipos[id]
        bit = free_bit(spec, "meshes among variants", SimulationError)
        spare = spec.worldbody.add_body(name=SPARE_BODY)
        for name in meshes:
            kind = mujoco.mjtGeom.mjGEOM_MESH
            spare.add_geom(type=kind, meshname=name, contype=bit, conaffinity=0, mass=0, rgba=[0, 0, 0, 0])
        return spec.compile()
