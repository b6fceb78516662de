"""Contacts between the tasks' objects and the hand resist twisting."""

from pathlib import Path

import pytest

from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import compile_sensors
from tgdsl.scene.scene import Choice, SceneModels

TASKS = Path(__file__).parents[2] / "examples" / "tasks"
LIMITS = {
    "in_palm_rotate": ("item", 0.002),
    "in_hand_repose": ("item", 0.002),
    "in_hand_repose_sharpa": ("item", 0.0015),
    "screwdriver": ("screwdriver", 0.002),
    "grip_force": ("item", 0.005),
}
"""For each task: the object and its torsional friction, the largest torque over the normal force [m]."""

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("task", LIMITS)
def test_every_variant_of_an_object_resists_twisting(task):
    name, limit = LIMITS[task]
    loaded = load_task(TASKS / f"{task}.yaml", {"touch": "none"})
    sensors = compile_sensors(loaded, "cpu")
    scene = sensors.touch.plan.scene
    models = SceneModels(scene, loaded.spec.physics.options)
    (scene_object,) = [candidate for candidate in scene.objects if candidate.name == name]
    for variant in range(len(scene_object.variants)):
        model = models.model({name: Choice(variant)})
        geoms = [i for i in range(model.ngeom) if model.body(int(model.geom_bodyid[i])).name == sensors.object]
        colliding = [i for i in geoms if model.geom_contype[i] or model.geom_conaffinity[i]]
        assert colliding
        for i in colliding:
            assert model.geom_condim[i] == 4 and model.geom_friction[i, 1] == limit
            assert model.geom_priority[i] > max(model.geom_priority[j] for j in range(model.ngeom) if j not in geoms)
