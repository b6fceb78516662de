"""Documents that name a material: a body's modes follow from its shape in MuJoCo."""

import numpy as np
import pytest
import trimesh
from oracles.setups.solids import box, surface_of
from oracles.setups.sounds import plate_document
from ringing_bodies import slabs, thin_box

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.modal import analysis as spectra
from tgdsl.modal.analysis import analysed
from tgdsl.modal.modes import ShapeModes

SIDE, WALL = 0.1, 0.004
STEEL = {"material": "steel", "count": 6}
WALLS = "".join(
    f'<geom type="box" size="{" ".join(map(str, np.ptp(wall.vertices, axis=0) / 2))}" pos="{" ".join(map(str, wall.bounds.mean(axis=0)))}"/>'
    for wall in slabs(SIDE, WALL)
)
SCENE = """
<mujoco>
  <option timestep="0.001"/>
  <asset><mesh name="case" file="{file}" inertia="exact"/></asset>
  <worldbody>
    <body name="plate"><geom name="plate" type="box" size=".1 .1 .005"/></body>
    <body name="walls" pos="0 0 1"><freejoint/>{walls}</body>
    <body name="case" pos="0 0 2" quat=".8 .2 .4 .4"><freejoint/><geom type="mesh" mesh="case" pos=".01 .02 .03"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setattr(spectra, "UNKNOWNS", 2500)


def document(folder, mesh: trimesh.Trimesh, **sensor) -> dict:
    mesh.export(folder / "case.stl")
    spec = plate_document(folder, of="object", **sensor)
    (folder / "plate.xml").write_text(SCENE.format(file=folder / "case.stl", walls=WALLS))
    spec["objects"] = {name: {"body": name} for name in ("walls", "case")}
    spec["sensors"]["s"]["feels"] = ["walls", "case"]
    return spec


def test_thin_walled_boxes_of_geoms_and_of_a_mesh(tmp_path):
    """Six slabs, and a mesh with an inner shell that MuJoCo collides as its hull: both ring like the box with a cavity."""
    touch = tgdsl.compile(document(tmp_path, thin_box(SIDE, WALL), modes=STEEL, samples=64))
    planned = touch.plan.sensors[0].constants
    expected = analysed("box", surface_of(thin_box(SIDE, WALL)), ShapeModes(material="steel", count=6), 0.45 * 64_000)
    assert len(expected.frequency) >= 4
    for row, tolerance in ((0, 1e-6), (1, 1e-5)):  # coordinates of a mesh are float32
        num = len(expected.frequency)
        assert planned["frequency"][row, :num] == pytest.approx(expected.frequency, rel=tolerance)


def test_materials_differ_in_pitch_and_decay(tmp_path):
    """Bodies that differ only in material: wood is lower than steel and decays faster."""
    modes = {"bodies": {"case": "wood"}, "modes": STEEL, "samples": 32}
    planned = tgdsl.compile(document(tmp_path, thin_box(SIDE, WALL), **modes)).plan.sensors[0].constants
    assert planned["frequency"][1, 0] < 0.5 * planned["frequency"][0, 0]
    assert (planned["frequency"] > 0).sum(axis=1).min() >= 4


def test_a_mesh_without_an_inside_is_a_mistake(tmp_path):
    mesh = box((SIDE, SIDE, SIDE))
    mesh.update_faces(np.arange(12) > 1)
    spec = document(tmp_path, mesh, modes=STEEL)
    text = (tmp_path / "plate.xml").read_text().replace('inertia="exact"', 'inertia="shell"')
    (tmp_path / "plate.xml").write_text(text)
    with pytest.raises(SpecError, match=r'sensors\.s\.modes: modes of "case": geom "case" is open: \d+ mm of edges'):
        tgdsl.compile(spec)


def test_a_material_that_does_not_ring_is_a_mistake(tmp_path):
    with pytest.raises(SpecError, match=r'sensors\.s\.modes: modes of "plate": skin has no Young\'s modulus'):
        tgdsl.compile({**plate_document(tmp_path, modes="skin")})
