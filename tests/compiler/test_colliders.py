"""`robot: {collision: primitive}` in documents: scenes, artefacts, varying objects and located mistakes."""

import mujoco
import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.scene.scene import scene_digest, scene_model

ROBOT = """<mujoco><worldbody>
  <body name="pad" pos="0 0 .1"><joint name="press" type="slide" axis="0 0 1"/>
    <inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>
    <geom name="pad" type="mesh" mesh="slab" friction=".4"/></body>
</worldbody>
<asset><mesh name="slab" vertex="-.05 -.05 -.01 .05 -.05 -.01 -.05 .05 -.01 .05 .05 -.01 -.05 -.05 .01 .05 -.05 .01 -.05 .05 .01 .05 .05 .01"/></asset>
</mujoco>"""
SCENE = """<mujoco><option timestep=".002"/>
<asset><model name="robot" file="{file}"/></asset>
<worldbody>
  <attach model="robot" body="pad" prefix=""/>
  <body name="ball" pos="0 0 .2"><freejoint/><geom name="ball" type="sphere" size=".02" density="500"/></body>
</worldbody>
<actuator><position joint="press" kp="1000" dampratio="1"/></actuator></mujoco>"""
COLLIDERS = """tgdsl: 1
bodies:
  pad:
    - {type: box, size: [5 cm, 5 cm, 10 mm], pos: [0, 0, 2 mm], core: true}
    - {type: sphere, size: [0.005], pos: [0.2, 0, 0]}
"""
TAXELS = {"method": "grid", "rows": 3, "columns": 3, "direction": [0, 0, -1], "radius": 0.004}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "scene.xml").write_text(SCENE.format(file=tmp_path / "robot.xml"))
    (tmp_path / "colliders.yaml").write_text(COLLIDERS)
    return tmp_path


def document(folder, collision="primitive", placement=TAXELS, **ball):
    return {
        "tgdsl": 1,
        "robot": {
            "model": str(folder / "robot.xml"),
            "layout": {"resolutions": {"r": {"pad": placement}}},
            "collision": collision,
        },
        "scene": {"model": str(folder / "scene.xml")},
        "objects": {"ball": {"body": "ball", **ball}},
        "sensors": {
            "s": {"kind": "surface_distance", "links": "pad", "feels": ["ball"], "max_range": 1.0},
            "f": {"kind": "link_contact", "links": "pad", "feels": ["ball"], "outputs": ["force"]},
        },
    }


@pytest.mark.parametrize("surface", ["mesh", "collision"])
def test_taxels_stay_and_contacts_count_for_the_same_link(folder, surface):
    """A ball rests on the box 2 mm higher than on the mesh, with its weight on the pad's only row."""
    touch_and_height = {}
    for collision in ("mesh", "primitive"):
        touch = tgdsl.compile(document(folder, collision, TAXELS | {"surface": surface}), dtype=torch.float64)
        sim = tgdsl.simulate(touch, 1, substeps=10)
        for _ in range(100):
            sim.step()
        readings = touch(sim.state())
        weight = sim.model.body("ball").mass[0] * 9.81
        assert readings["f"][0, 0, :3].numpy() == pytest.approx([0, 0, -weight], abs=2e-3 * weight)
        touch_and_height[collision] = touch, sim.qpos[0, 3] - sim.qpos[0, 0]
    assert touch_and_height["mesh"][0].plan.taxels_id == touch_and_height["primitive"][0].plan.taxels_id
    assert float(touch_and_height["primitive"][1] - touch_and_height["mesh"][1]) == pytest.approx(0.002, abs=2e-5)


def test_an_artefact_keeps_the_colliders(folder):
    touch = tgdsl.compile(document(folder))
    tgdsl.save(touch, folder / "touch.safetensors")
    loaded = tgdsl.load(folder / "touch.safetensors")
    assert loaded.plan.scene == touch.plan.scene and len(touch.plan.scene.colliders) == 2
    model = scene_model(loaded.plan.scene)
    assert [model.geom(f"tgdsl/pad/collider/{i}").type[0] for i in range(2)] == [
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_SPHERE,
    ]
    np.testing.assert_allclose(model.geom("tgdsl/pad/collider/0").friction[0], 0.4)
    assert model.body("pad").mass[0] == 0.1


def test_a_document_without_colliders_has_an_unchanged_scene(folder):
    touch = tgdsl.compile(document(folder, "mesh"))
    assert touch.plan.scene.colliders == () and scene_model(touch.plan.scene).ngeom == 2
    assert scene_digest(touch.plan.scene) != scene_digest(tgdsl.compile(document(folder)).plan.scene)


def test_objects_may_vary_with_colliders(folder):
    """In two environments, each ball rests at its own radius above the box."""
    variants = [{"type": "sphere", "size": [r], "density": 500} for r in (0.02, 0.03)]
    touch = tgdsl.compile(document(folder, variants=variants), dtype=torch.float64)
    sim = tgdsl.simulate(touch, 2, substeps=10)
    sim.set_objects(variants={"ball": [0, 1]})
    for _ in range(150):
        sim.step()
    heights = (sim.qpos[:, 3] - sim.qpos[:, 0]).tolist()
    assert heights == pytest.approx([0.1 + 0.012 + 0.02, 0.1 + 0.012 + 0.03], abs=6e-4)  # MuJoCo's contacts are soft


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "has no primitive colliders: there is no file"),
        (
            COLLIDERS.replace("pad:", "pat:"),
            'colliders.yaml has colliders of "pat", which is no body of the scene; did you mean',
        ),
        (COLLIDERS.replace("[0.005]", "[0.005, 1]"), "a sphere has 1 sizes, found 2"),
        (COLLIDERS.replace("sphere", "mesh"), "bodies.pad[1].type"),
        ("tgdsl: 1\nbodies: {}\n", "colliders.yaml:2"),
    ],
)
def test_mistakes_in_colliders_are_located(folder, text, says):
    (folder / "colliders.yaml").unlink() if text is None else (folder / "colliders.yaml").write_text(text)
    with pytest.raises(SpecError) as error:
        tgdsl.compile(document(folder))
    assert says in str(error.value)


def test_unknown_kinds_of_collision_are_refused(folder):
    with pytest.raises(SpecError, match=r"robot\.collision"):
        tgdsl.compile(document(folder, "capsules"))
