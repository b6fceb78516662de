"""MuJoCo Warp environments with different objects or model fields, against MuJoCo's batch."""

import numpy as np
import pytest
import torch
import trimesh
from warp_cases import (
    MOVING_FORCE,
    SCENE,
    assert_agree,
    hand_over,
    module,
    warp,
)

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation

# environments that differ


VARIANTS = [
    {"type": "box", "size": [0.02, 0.015, 0.01]},
    {"type": "sphere", "size": [0.015], "pos": [0.004, 0, 0]},
    {"type": "box", "size": [0.01, 0.02, 0.02]},
    {"geoms": [{"type": "sphere", "size": [0.012], "pos": [0, 0, 0.02]}, {"type": "box", "size": [0.01, 0.01, 0.015]}]},
]


ITEMS = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="10" integrator="implicitfast"/>
  <worldbody>
    <body name="table"><geom type="box" size=".2 .2 .01"/></body>
    <geom type="plane" size="1 1 .1" pos="0 0 -.1"/>
    <body name="first" pos="0 0 .0297"><freejoint/><geom size=".01"/></body>
    <body name="second" pos=".005 0 .0803"><freejoint/><geom size=".01"/></body>
    <body name="rod" pos="-.1 0 .0198"><freejoint/><geom type="box" size=".01 .02 .01"/></body>
    <body name="post" pos="-.5 0 0" euler="0 0 30"><geom size=".01"/></body>
    <body name="finger" pos="-.5 0 .0695"><freejoint/><geom size=".02"/></body>
  </worldbody>
</mujoco>
"""


def items_module(folder) -> TactileModule:
    """Return a module with two objects with variants and one with a size on a table, and a post with variants."""
    (folder / "items.xml").write_text(ITEMS)
    points = [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.005}]
    feels = ["first", "second", "rod"]
    posts = [{"type": "box", "size": [0.03, 0.02, 0.05]}, {"type": "box", "size": [0.02, 0.02, 0.02], "pos": [0.005, 0, 0.03]}]
    document = {
        "tgdsl": 1,
        "robot": {
            "model": str(folder / "items.xml"),
            "layout": {"resolutions": {"only": {link: {"method": "points", "points": points} for link in ("table", "finger")}}},
        },
        "objects": {
            "first": {"body": "first", "variants": VARIANTS},
            "second": {"body": "second", "variants": VARIANTS[::-1]},
            "rod": {"body": "rod", "size": "per_env"},
            "post": {"body": "post", "variants": posts},
        },
        "sensors": {
            "touch": {"kind": "kinematic_taxel", "links": "table", "feels": feels},
            "force": {"kind": "link_contact", "links": "table", "feels": feels},
            "tip": {"kind": "link_contact", "links": "finger", "feels": ["post"]},
        },
    }
    return tgdsl.compile(document)


@pytest.mark.slow
def test_environments_with_different_objects_match_the_cpu(tmp_path):
    """Each environment against MuJoCo with a model compiled for it; absent geoms must not collide."""
    touch = items_module(tmp_path)
    sim, cpu = warp(touch, 8), BatchSimulation(touch, 8)
    sim.warp_model.opt.tolerance.fill_(sim.model.opt.tolerance)
    rng = np.random.default_rng(2)
    pairs = [pair.object for pair in touch.inputs.pairs]
    num_touching = torch.zeros(8, len(pairs))
    for attempt in range(3):
        if attempt:
            choice = {"first": rng.integers(4, size=4), "second": rng.integers(4, size=4)}
            sizes = {"rod": rng.uniform(0.01, 0.03, size=(4, 3))}
            ids = np.sort(rng.permutation(8)[:4])
            cpu.set_objects(choice, sizes, ids)
            sim.set_objects({k: v[::-1] for k, v in choice.items()}, {k: v[::-1] for k, v in sizes.items()}, ids[::-1].copy())
        for name in ("body_mass", "body_inertia", "geom_size"):
            expected = [getattr(cpu.batch.get_model(env), name) for env in range(8)]
            np.testing.assert_allclose(sim.parameters[name], expected, rtol=1e-6, atol=1e-12, err_msg=name)
        for _ in range(60):
            hand_over(sim, cpu)
            sim.step()
            cpu.step()
            state = sim.state()
            assert_agree(state, cpu.state(), touch.inputs.fields, MOVING_FORCE)
            num_touching += state.contact_found > 0
    assert num_touching[:, [pairs.index("first"), pairs.index("rod"), pairs.index("post")]].min() > 0
    assert num_touching[:, pairs.index("second")].any()


@pytest.mark.slow
def test_mesh_variants_match_the_cpu(tmp_path):
    """MuJoCo builds hulls only for meshes in use: every environment needs the hulls of all variants."""
    trimesh.creation.icosphere(subdivisions=2, radius=0.03).apply_translation([0.01, 0.02, 0.02]).export(tmp_path / "ball.stl")
    trimesh.creation.box(extents=[0.05, 0.03, 0.06]).apply_translation([0, 0.01, 0]).export(tmp_path / "brick.stl")
    variants = [
        {"mesh": str(tmp_path / "ball.stl")},
        {"type": "box", "size": [0.02, 0.02, 0.02]},
        {"mesh": str(tmp_path / "brick.stl"), "pos": [0.002, 0, 0.01]},
        {"mesh": str(tmp_path / "ball.stl"), "scale": 0.5},
    ]
    text = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .06"')
    touch = module(tmp_path, text, links=("table",), target={"variants": variants, "tolerance": 2e-4})
    sim, cpu = warp(touch, 8), BatchSimulation(touch, 8)
    sim.warp_model.opt.tolerance.fill_(sim.model.opt.tolerance)
    num_touching = torch.zeros(8, 1)
    for _ in range(200):
        hand_over(sim, cpu)
        sim.step()
        cpu.step()
        state = sim.state()
        assert_agree(state, cpu.state(), touch.inputs.fields)
        num_touching += state.contact_found > 0
    assert num_touching.min() > 50


@pytest.mark.slow
def test_environments_may_have_different_frictions(tmp_path):
    """Coulomb: a cube that slides on friction μ loses μ g of its speed per second."""
    touch = module(tmp_path, SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .03"').replace('impratio="10"', 'impratio="100"'))
    sim = warp(touch, 2, per_env=["geom_friction"], substeps=50)
    friction = torch.tensor([0.05, 0.2])
    sim.parameters["geom_friction"][:, :, 0] = friction[:, None]
    sim.step()
    sim.arrays["qvel"][:, 0] = 0.3
    sim.step()
    lost_speed = 0.3 - sim.arrays["qvel"][:, 0]
    torch.testing.assert_close(lost_speed, friction * 9.81 * 50 * 0.002, rtol=0.02, atol=0)
