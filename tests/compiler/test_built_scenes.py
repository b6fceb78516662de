"""Scenes passed in memory read the same as from their files."""

import copy
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from pxr import Usd

import tgdsl
from tgdsl.errors import RobotError, SpecError, TgdslError
from tgdsl.formats.robot import export_model
from tgdsl.scene.compare import differing_fields

TETRAHEDRON = "v 0 0 0\nv .031 0 0\nv 0 .04 0\nv 0 0 .0123\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
FIELD = '<geom type="hfield" hfield="ground" pos="0 0 -1"/>'
SCENE = f"""
<mujoco><asset>
  <mesh name="tip" file="tip.obj" scale="1 1 2"/>
  <texture name="wood" type="2d" file="wood.png"/><material name="wood" texture="wood"/>
  <hfield name="ground" nrow="2" ncol="3" size="1 1 .1 .1" elevation="0 .1 .2 .3 .4 1"/>
</asset><worldbody>
  {FIELD}
  <body name="robot/palm" pos=".123456789 0 0" euler="10 20 30">
    <geom type="box" size=".05 .05 .0123456789" material="wood"/>
    <body name="robot/tip" pos="0 0 .04"><joint name="robot/bend" axis="0 1 0"/><geom type="mesh" mesh="tip"/></body>
  </body>
  <body name="cube" pos=".12 0 .0295"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>
"""
PAIR = '</worldbody><contact><pair geom1="one" geom2="two"/></contact>'
LAYOUT = {"resolutions": {"only": {"robot/*": {"method": "poisson", "count": 12, "radius": 0.004}}}}
DOCUMENT = {
    "tgdsl": 1,
    "robot": {"layout": LAYOUT},
    "objects": {"cube": {"body": "cube"}},
    "sensors": {
        "skin": {"kind": "surface_distance", "links": ["robot/*"], "feels": ["cube"]},
        "load": {"kind": "force_taxel", "links": ["robot/*"], "feels": ["cube"]},
    },
}


def write(folder, scene=SCENE) -> str:
    from PIL import Image

    (folder / "tip.obj").write_text(TETRAHEDRON)
    Image.new("RGB", (2, 2)).save(folder / "wood.png")
    (folder / "scene.xml").write_text(scene)
    return str(folder / "scene.xml")


def in_memory(folder, scene=SCENE) -> mujoco.MjSpec:
    """Return the scene with all its files in memory."""
    file = write(folder, scene)
    assets = {name: (folder / name).read_bytes() for name in ("tip.obj", "wood.png")}
    return mujoco.MjSpec.from_string(Path(file).read_text(), assets=assets)


def readings(touch) -> dict[str, torch.Tensor]:
    state, rng = touch.example_state(3).to(torch.float64), torch.Generator().manual_seed(0)
    state.body_pos += 0.03 * torch.randn(state.body_pos.shape, generator=rng, dtype=torch.float64)
    return touch(state)


@pytest.mark.parametrize("built", ["spec", "model", "stage"])
def test_readings_equal_those_of_the_scene_from_its_file(tmp_path, built):
    scene = in_memory(tmp_path, SCENE if built == "spec" else SCENE.replace(FIELD, ""))  # USD has no height fields
    if built == "model":
        scene = scene.compile()
    elif built == "stage":
        export_model(tmp_path / "scene.xml", tmp_path / "scene.usda")
        scene = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    named = DOCUMENT | {"robot": {"model": str(tmp_path / "scene.xml"), "layout": LAYOUT}}
    expected = tgdsl.compile(named, dtype=torch.float64)
    touch = tgdsl.compile(DOCUMENT, dtype=torch.float64, scene=scene)
    tolerance = 1e-6 if built == "stage" else 0.0
    assert touch.inputs.bodies == expected.inputs.bodies
    for name, value in readings(expected).items():
        np.testing.assert_allclose(readings(touch)[name], value, rtol=0, atol=tolerance * float(value.abs().max()))


def test_the_artefact_simulates_without_the_files(tmp_path):
    folder = tmp_path / "built"
    folder.mkdir()
    spec = in_memory(folder)
    touch = tgdsl.compile(DOCUMENT, scene=spec)
    for file in folder.iterdir():
        file.unlink()
    tgdsl.save(touch, tmp_path / "touch.safetensors")
    sim = tgdsl.simulate(tgdsl.load(tmp_path / "touch.safetensors"), 2)
    sim.step()
    assert touch(sim.state())["load"].shape[0] == 2
    compiled = spec.copy().compile()
    assert not {"mesh_vert", "geom_pos", "geom_size", "body_inertia", "hfield_data", "jnt_axis"} & set(
        differing_fields(compiled, sim.model, is_rounded=True)
    )


def test_a_model_with_a_floor_needs_no_spec():
    """A plane's size only affects drawing; it collides without bounds."""
    text = """<mujoco><worldbody><geom type="plane" size="1 2 .1"/>
    <body name="pad" pos="0 0 .1"><geom type="box" size=".02 .02 .005"/></body>
    <body name="cube" pos="0 0 .2"><freejoint/><geom type="box" size=".02 .02 .02"/></body></worldbody></mujoco>"""
    load = {"kind": "link_contact", "links": ["pad"], "feels": ["cube"]}
    document = {"tgdsl": 1, "objects": {"cube": {"body": "cube"}}, "sensors": {"load": load}}
    touch = tgdsl.compile(document, scene=mujoco.MjModel.from_xml_string(text))
    assert touch.inputs == tgdsl.compile(document, scene=mujoco.MjSpec.from_string(text)).inputs
    sim = tgdsl.simulate(touch, 1)
    sim.step()
    assert touch(sim.state())["load"].shape == (1, 1, 4)


def test_models_in_a_document_must_match_the_scene(tmp_path):
    spec = mujoco.MjSpec.from_file(write(tmp_path))
    named = DOCUMENT | {"robot": {"model": str(tmp_path / "scene.xml"), "layout": LAYOUT}}
    assert tgdsl.compile(named, scene=spec).inputs == tgdsl.compile(named).inputs
    spec.body("robot/tip").pos[2] += 0.001
    spec.body("robot/palm").geoms[0].size[0] += 0.001
    with pytest.raises(SpecError) as error:
        tgdsl.compile(named, scene=spec)
    problem = "this model is not the one in the given scene: body robot/palm: geoms, body robot/tip: place"
    assert f"robot.model: {problem}" in str(error.value)
    (tmp_path / "hand.yaml").write_text(
        f"tgdsl: 1\nrobot:\n  model: {tmp_path / 'scene.xml'}\n  layout: {LAYOUT}\nsensors: {DOCUMENT['sensors']}\nobjects: {DOCUMENT['objects']}\n"
    )
    with pytest.raises(SpecError, match=r"hand\.yaml:3:\d+: robot\.model: this model is not the one"):
        tgdsl.compile(tmp_path / "hand.yaml", scene=spec)
    other = mujoco.MjSpec.from_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(SpecError, match=r'the scene has no body "robot/palm", the scene has no body "robot/tip"'):
        tgdsl.compile(named, scene=other)


def test_unsupported_uses_of_a_given_scene_are_refused(tmp_path):
    spec = in_memory(tmp_path)
    tuned = copy.deepcopy(DOCUMENT)
    tuned["sensors"]["skin"]["accuracy"] = "1 %"
    for document, scene, error, message in (
        (DOCUMENT, SCENE, TgdslError, "scene is an MjSpec, an MjModel or a Usd.Stage, found str"),
        (tuned, spec, TgdslError, "`accuracy` takes a run of the scene; compile without `scene=`, or set it to null"),
        (
            DOCUMENT | {"robot": {"layout": LAYOUT, "collision": "primitive"}},
            spec,
            SpecError,
            "primitive colliders are read from the robot's folder",
        ),
        (DOCUMENT | {"objects": {"cube": {"body": "cub"}}}, spec, SpecError, 'no body is named "cub"; did you mean "cube"?'),
    ):
        with pytest.raises(error, match=re.escape(message)):
            tgdsl.compile(document, scene=scene)
    plain = SCENE.replace(FIELD, "").replace('<geom type="box"', '<geom name="one" type="box"', 1)
    plain = plain.replace("<freejoint/><geom", '<freejoint/><geom name="two"')
    for text, message in (
        (SCENE, "of type hfield, which USD does not have; pass the MjSpec that this MjModel was compiled from"),
        (plain.replace("</worldbody>", PAIR), "from this MjModel alone, npair would change"),
    ):
        with pytest.raises(RobotError, match=re.escape(message)):
            tgdsl.compile(DOCUMENT, scene=mujoco.MjModel.from_xml_path(write(tmp_path, text)))
    with pytest.raises(SpecError, match=r'robot: missing key "model"'):
        tgdsl.compile(DOCUMENT)
