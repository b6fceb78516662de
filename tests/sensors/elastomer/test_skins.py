"""Skins by name: their numbers against their sources, what a sensor may override, and what `explain` states."""

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.module.artifact import load_plan, save_plan
from tgdsl.schema.document import json_schema
from tgdsl.sensors.elastomer.spec import SKINS, ElastomerSpec, young_of_shore

SCENE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
  <body name="item" pos="0 0 .03"><freejoint/><geom type="sphere" size=".02"/></body>
</worldbody></mujoco>"""
GRID = "{method: grid, rows: 3, columns: 4, direction: [0, 0, -1], radius: 2 mm}"
DOCUMENT = f"""tgdsl: 1
robot: {{model: scene.xml, layout: {{resolutions: {{only: {{pad: {GRID}}}}}}}}}
objects: {{item: {{body: item}}}}
sensors:
  s: {{kind: elastomer, links: pad, feels: [item], FIELDS}}
"""


def spec(**fields) -> ElastomerSpec:
    return ElastomerSpec.model_validate({"kind": "elastomer", "links": "pad", "feels": ["item"], **fields})


def document(folder, fields: str) -> str:
    (folder / "scene.xml").write_text(SCENE)
    (folder / "hand.yaml").write_text(DOCUMENT.replace("FIELDS", fields))
    return str(folder / "hand.yaml")


WIDE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
  <body name="item" pos="0 0 .02"><freejoint/><geom type="box" size=".03 .03 .01"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(("skin", "poissons_ratio"), [("soft_gel", 0.0), ("firm_rubber", 0.3), ("soft_gel", 0.48)])
def test_a_layer_dragged_everywhere_follows_the_drag(tmp_path, skin, poissons_ratio):
    """Simple shear of a finite pad: markers on a surface that sticks everywhere move with it, whatever E and ν.

    The field of a taxel's patch is a disc's, which overlaps its neighbours: 8 % at 2 mm on a layer of 2 mm.
    """
    (tmp_path / "scene.xml").write_text(WIDE)
    line = np.linspace(-0.02, 0.02, 21)
    points = [
        {"pos": [x, y, 0.01], "normal": [0, 0, 1], "radius": 1e-3, "area": 4e-6} for x in line.tolist() for y in line.tolist()
    ]
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(tmp_path / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
            },
            "objects": {"item": {"body": "item"}},
            "sensors": {
                "s": {"kind": "elastomer", "like": skin, "links": "pad", "feels": ["item"], "poissons_ratio": poissons_ratio}
            },
        },
        dtype=torch.float64,
    )
    state, drag = touch.example_state(1), 1e-4
    pos, quat = torch.zeros_like(state.body_pos), torch.zeros_like(state.body_quat)
    quat[..., 0] = 1
    for share in np.linspace(0, 1, 6):
        item = torch.tensor([share * drag, 0, 0.02 - 5e-5], dtype=torch.float64)
        pos[0, touch.inputs.bodies.index("item")] = item
        readings = touch(tgdsl.SceneState(body_pos=pos, body_quat=quat, contact_found=torch.ones(1, 1)))["s"]
    centre = readings[0, len(points) // 2].numpy()
    assert centre[0] == pytest.approx(drag, rel=0.08)
    assert abs(centre[1]) < 1e-3 * drag


def test_the_papers_gel_has_the_papers_numbers():
    """Chung et al., appendix: s_d = s_s = 100, λ_d = 8000, λ_s = 2000, α = 1.2, c = 1, 1e-5 m, 1e-4 m, 1000 points, no edge."""
    gel = spec(like="paper_gel")
    assert (gel.dilation_strength, gel.shear_strength, gel.dilation_falloff, gel.shear_falloff) == (100, 100, 8000, 2000)
    assert (gel.depth_exponent, gel.compressibility, gel.enter, gel.exit) == (1.2, 1.0, 1e-5, 1e-4)
    assert (gel.model, gel.anchored, gel.points, gel.boundary, gel.kernel) == ("paper", "points", 1000, None, "gaussian")
    assert gel.model_dump(exclude={"like"}) == spec(model="paper").model_dump(exclude={"like"})


@pytest.mark.parametrize(("name", "shore", "more"), [("soft_gel", 10.0, -0.05), ("firm_rubber", 50.0, 0.40)])
def test_moduli_follow_from_the_hardness(name, shore, more):
    """Gent's relation, and the deviation of Ruess' from it."""
    young = spec(like=name).youngs_modulus
    assert young is not None
    gent = 0.0981 * (56 + 7.62336 * shore) / (0.137505 * (254 - 2.54 * shore)) * 1e6
    assert young == pytest.approx(gent, rel=2e-3)
    assert young_of_shore(shore) == pytest.approx(gent, rel=1e-14)
    assert 10 ** (0.0235 * shore - 0.6403) * 1e6 / gent - 1 == pytest.approx(more, abs=0.02)


@pytest.mark.parametrize("fields", [{}, {"thickness": "1 mm"}, {"youngs_modulus": "0.2 MPa"}, {"poissons_ratio": 0.3}])
def test_the_normal_stiffness_is_the_layers(fields):
    """Isotropic elasticity with ε_xx = ε_yy = 0: σ_zz over the depth is (λ + 2 μ)/t."""
    skin = spec(like="soft_gel", **fields)
    young, nu, thickness = skin.youngs_modulus, skin.poissons_ratio, skin.thickness
    assert young is not None and thickness is not None
    lame, shear = young * nu / ((1 + nu) * (1 - 2 * nu)), young / (2 * (1 + nu))
    assert skin.normal_stiffness == pytest.approx((lame + 2 * shear) / thickness, rel=1e-13)
    assert spec(like="soft_gel", normal_stiffness=7e8, **fields).normal_stiffness == 7e8


def test_single_fields_override_a_skin():
    skin = spec(like="firm_rubber", thickness="1 mm", friction=0.8)
    assert (skin.thickness, skin.friction, skin.youngs_modulus) == (1e-3, 0.8, SKINS["firm_rubber"]["youngs_modulus"])
    half = spec(like="firm_rubber", kernel="half_space")
    assert half.thickness is None and half.normal_stiffness == spec(like="firm_rubber").normal_stiffness
    still = spec(like="paper_gel", shear_strength=0)
    assert not still.has_shear and still.dilation_strength == 100
    ours = spec(like="paper_gel", model="tgdsl", dilation_strength=5)
    assert (ours.model, ours.anchored, ours.dilation_strength) == ("tgdsl", "taxels", 5)


@pytest.mark.parametrize("name", SKINS)
def test_a_skin_reads_like_its_numbers(tmp_path, name):
    """Named, written out, and loaded from a file: the same readings to the last bit."""
    written = {**SKINS[name]}
    if written["kernel"] != "gaussian":
        written["normal_stiffness"] = spec(like=name).normal_stiffness
    texts = [f"like: {name}", ", ".join(f"{field}: {value}" for field, value in written.items())]
    named, plain = (tgdsl.compile(document(tmp_path, text), dtype=torch.float64) for text in texts)
    save_plan(named.plan, tmp_path / "hand.safetensors")
    again = tgdsl.load(tmp_path / "hand.safetensors", dtype=torch.float64)
    readings = []
    for touch in (named, plain, again):
        for seed in range(3):
            reading = touch(named.example_state(8, seed=seed, spread=0.01))["s"]
        readings.append(reading)
    assert readings[0].any() and np.isfinite(readings[0].numpy()).all()
    for other in readings[1:]:
        torch.testing.assert_close(other, readings[0], rtol=0, atol=0)
    assert load_plan(tmp_path / "hand.safetensors").to_json() == named.plan.to_json()


def test_explain_states_the_resulting_values(tmp_path):
    fields = "like: soft_gel, thickness: 1 mm, readout: both, noise: {radius_noise: 1e-4}"
    text = tgdsl.compile(document(tmp_path, fields)).explain()
    young = SKINS["soft_gel"]["youngs_modulus"]
    stiffness = spec(like="soft_gel", thickness=1e-3).normal_stiffness
    line = f"like soft_gel: kernel bonded_layer, thickness 0.001 m (own), poissons_ratio 0.48, youngs_modulus {young:g} Pa, "
    assert f"    {line}normal_stiffness {stiffness:g} Pa/m\n" in text
    assert "like" not in tgdsl.compile(document(tmp_path, "thickness: 1 mm")).explain()


KERNELS = "expected 'gaussian', 'half_space' or 'bonded_layer'"
WRONG = {
    "like: sft_gel": 'sensors.s.like: unknown skin "sft_gel"; did you mean "soft_gel"?',
    "like: wood": 'sensors.s.like: unknown skin "wood"; known skins: firm_rubber, paper_gel, soft_gel',
    "like: [soft_gel]": "sensors.s.like: found a list of 1, expected a string",
    "like: soft_gel, thicknes: 1": 'sensors.s.thicknes: unknown key "thicknes"; did you mean "thickness"?',
    "like: soft_gel, thickness: 1 N": 'sensors.s.thickness: "N" is not a unit of length, expected one of m, cm, mm, um, µm',
    "like: soft_gel, kernel: gaussian": 'sensors.s: the skin "soft_gel" has no values for the kernel gaussian, '
    "expected half_space or bonded_layer",
    "like: paper_gel, kernel: half_space": 'sensors.s: the skin "paper_gel" has no values for the kernel half_space, '
    "expected gaussian",
    "like: soft_gel, poissons_ratio: 0.5": "sensors.s: `normal_stiffness` is missing, the kernel bonded_layer needs it",
    "like: soft_gel, kernel: halfspace": f'sensors.s.kernel: found "halfspace", {KERNELS}',
}


@pytest.mark.parametrize("fields", WRONG)
def test_mistakes_name_their_place(tmp_path, fields):
    path = document(tmp_path, fields)
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(path)
    (problem,) = caught.value.problems
    assert str(problem).split(": ", 1)[1] == WRONG[fields]
    assert problem.line == 5


def test_the_schema_lists_the_skins():
    assert json_schema()["$defs"]["ElastomerSpec"]["properties"]["like"]["enum"] == list(SKINS)
