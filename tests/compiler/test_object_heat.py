"""Thermal properties of objects: materials, and volumes, areas and boxes of geoms."""

import numpy as np
import pytest
import trimesh

from tgdsl.compiler.resolve import resolve
from tgdsl.fields.materials import MATERIALS
from tgdsl.schema.load import load
from tgdsl.surfaces.sensed import ObjectHeat

SCENE = """
<mujoco>
  <asset><mesh name="bent" file="{}"/></asset>
  <worldbody>
    <body name="pad"><freejoint/><geom size=".05"/></body>
    <geom name="ground" type="plane" size="1 1 .1"/>
    <body name="floor" pos="0 0 -1"><geom type="plane" size="1 1 .1"/></body>
    <body name="ball" pos="1 0 0"><freejoint/><geom size=".04"/></body>
    <body name="mug" pos="2 0 0">
      <freejoint/>
      <geom type="cylinder" size=".04 .05"/>
      <body name="handle" pos=".05 0 0" quat="1 1 0 0"><geom type="box" size=".01 .02 .03"/></body>
      <body name="lid" pos="0 0 .06"><joint axis="1 0 0"/><geom type="box" size=".04 .04 .005"/></body>
    </body>
    <body name="bent" pos="3 0 0"><freejoint/><geom type="mesh" mesh="bent" pos="0 0 .5"/></body>
  </worldbody>
</mujoco>
"""


def heat_of(folder, body, **target) -> ObjectHeat | None:
    """Return an object's thermal properties."""
    angle = [trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation(at) for at in ((0, 0, 0), (0.02, 0, 0), (0, 0.02, 0))]
    trimesh.util.concatenate(angle).export(folder / "bent.stl")
    (folder / "scene.xml").write_text(SCENE.format(folder / "bent.stl"))
    point = {"method": "points", "points": [{"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": 0.01}]}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": {"pad": point}}}},
        "objects": {"item": {**({} if body is None else {"body": body}), **target}},
        "sensors": {"s": {"kind": "contact_depth", "gate": "geometric", "links": "pad", "feels": ["item"]}},
    }
    return resolve(load(document)).objects["item"].heat


def test_objects_without_a_material_have_no_heat(tmp_path):
    assert heat_of(tmp_path, "ball") is None


def test_a_ball(tmp_path):
    heat = heat_of(tmp_path, "ball", material="rubber", temperature="45 degC", cells=[2, 3, 4])
    assert heat is not None
    assert (heat.temperature, heat.is_per_env, heat.cells) == (45.0, False, (2, 3, 4))
    assert heat.materials == (MATERIALS["rubber"],)
    np.testing.assert_allclose(heat.volume, [4 / 3 * np.pi * 0.04**3], rtol=1e-14)
    np.testing.assert_allclose(heat.area, [4 * np.pi * 0.04**2], rtol=1e-14)
    np.testing.assert_allclose(heat.curvature, [25.0], rtol=1e-14)
    np.testing.assert_allclose(heat.box_center, np.zeros((1, 3)), atol=1e-16)
    np.testing.assert_allclose(heat.box_size, np.full((1, 3), 0.08), rtol=1e-14)
    heat = heat_of(tmp_path, "ball", material=["steel", {"like": "wood", "density": 700}], temperature={"per_env": "300 K"})
    assert heat is not None and heat.is_per_env and heat.temperature == pytest.approx(26.85) and heat.cells is None
    assert [material.density for material in heat.materials] == [7854.0, 700.0]
    heat = heat_of(tmp_path, "ball", material="steel")
    assert heat is not None and heat.temperature is None and not heat.is_per_env


def test_welded_bodies_are_part_of_their_parent(tmp_path):
    """The handle is rotated by 90° about x, which swaps y and z; the lid has a joint."""
    heat = heat_of(tmp_path, "mug", material="glass")
    assert heat is not None
    np.testing.assert_allclose(heat.volume, [np.pi * 0.04**2 * 0.1 + 0.02 * 0.04 * 0.06], rtol=1e-12)
    np.testing.assert_allclose(heat.box_center, [[0.01, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(heat.box_size, [[0.1, 0.08, 0.1]], rtol=1e-12)


@pytest.mark.parametrize("surface", ["collision", "bent"])
def test_a_mesh_holds_heat_in_its_own_volume_not_its_hulls(tmp_path, surface):
    """Three cubes in an L: MuJoCo rotates a mesh to its principal axes, but the box stays in the body's frame."""
    heat = heat_of(tmp_path, "bent", material="abs", surface=surface)
    assert heat is not None
    np.testing.assert_allclose(heat.volume, [3 * 0.02**3], rtol=1e-5)
    np.testing.assert_allclose(heat.box_center, [[0.01, 0.01, 0.5]], atol=1e-7)
    np.testing.assert_allclose(heat.box_size, [[0.04, 0.04, 0.02]], rtol=1e-5)
    np.testing.assert_allclose(heat.curvature, [0.0])


def test_variants_have_separate_thermal_properties(tmp_path):
    variants = [
        {"type": "sphere", "size": ["2 cm"], "pos": [0, 0, 0.1]},
        {"geoms": [{"type": "box", "size": [0.01, 0.02, 0.03]}, {"type": "sphere", "size": [0.01], "pos": [0.2, 0, 0]}]},
    ]
    heat = heat_of(tmp_path, None, material="steel", variants=variants)
    assert heat is not None
    np.testing.assert_allclose(heat.volume, [4 / 3 * np.pi * 0.02**3, 48e-6 + 4 / 3 * np.pi * 0.01**3], rtol=1e-12)
    areas = 8 * (0.0002 + 0.0006 + 0.0003), 4 * np.pi * 0.01**2
    np.testing.assert_allclose(heat.area, [4 * np.pi * 0.02**2, sum(areas)], rtol=1e-12)
    np.testing.assert_allclose(heat.curvature, [50.0, 100.0 * areas[1] / sum(areas)], rtol=1e-12)
    np.testing.assert_allclose(heat.box_center, [[0, 0, 0.1], [0.1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(heat.box_size, [[0.04] * 3, [0.22, 0.04, 0.06]], rtol=1e-12)


def test_a_plane_is_a_half_space(tmp_path):
    heat = heat_of(tmp_path, "floor", material="wood")
    assert heat is not None
    assert np.isinf(heat.volume).all() and np.isinf(heat.box_size).all()
    assert (heat.area == 0).all() and (heat.curvature == 0).all() and (heat.box_center == 0).all()
