"""Mesh files as MuJoCo reads them: all objects of an OBJ file are one mesh, and a file that needs no change is left alone."""

import mujoco
import numpy as np
import pytest

from tgdsl.scene.scene import num_objects, readable

TETRAHEDRON = "v {0} 0 0\nv {1} 0 0\nv {0} 1 0\nv {0} 0 1\n"
FACES = ((1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4))


def obj(*names: str) -> bytes:
    """Return an OBJ file of tetrahedra of 1/6 m³, 10 m apart, each after a line with its name."""
    text = ""
    for i, name in enumerate(names):
        faces = "".join(f"f {' '.join(str(4 * i + corner) for corner in face)}\n" for face in FACES)
        text += f"{name}\n{TETRAHEDRON.format(10 * i, 10 * i + 1)}{faces}"
    return text.encode()


def volume(content: bytes) -> float:
    scene = """<mujoco><asset><mesh name="m" file="m.obj" inertia="exact"/></asset>
      <worldbody><body><geom type="mesh" mesh="m" density="1"/></body></worldbody></mujoco>"""
    return float(mujoco.MjModel.from_xml_string(scene, assets={"m.obj": content}).body_mass[1])


@pytest.mark.parametrize("names", [("o one",), ("g one",), ("# nothing",), ("o empty\no one",)])
def test_a_file_with_one_object_is_unchanged(names):
    content = obj(*names)
    assert num_objects(content) == 1
    assert readable("m.obj", content) is content


@pytest.mark.parametrize("names", [("o one", "o two"), ("g one", "  g two"), ("o one", "g"), ("o a", "o b", "g c")])
def test_all_objects_of_a_file_become_one_mesh(names):
    """Closed form: a tetrahedron of unit edges along the axes has 1/6 m³."""
    content = obj(*names)
    assert num_objects(content) == len(names)
    np.testing.assert_allclose(volume(readable("m.obj", content)), len(names) / 6, rtol=1e-6)
