"""Objects that differ between environments: one batch equals as many single runs."""

import json

import numpy as np
import pytest
import torch
import trimesh
from torch._dynamo.utils import counters

import tgdsl
from tgdsl.compiler.pipeline import compile_document
from tgdsl.compiler.scene import aligned
from tgdsl.errors import SimulationError, SpecError, StateError
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.sensors import KINDS
from tgdsl.testing import FLOAT64_TOLERANCE, ReferenceModule, assert_agrees

pytestmark = pytest.mark.filterwarnings("ignore::tgdsl.errors.UnfeltWarning")  # probes lie all through a ball
BOXES = [{"type": "box", "size": [0.015 + 0.0005 * i, 0.02, 0.018 + 0.0004 * i]} for i in range(14)]
CYLINDERS = [{"type": "cylinder", "size": [0.02, 0.02]}, {"type": "cylinder", "size": [0.016, 0.025]}]
PAPER = [*BOXES, *CYLINDERS]
"""The paper's training set: 14 boxes and 2 cylinders of about 4 cm."""
ODD = [
    {"type": "box", "size": [0.02, 0.015, 0.01]},
    {"type": "ellipsoid", "size": [0.02, 0.012, 0.016], "pos": [0.004, 0, 0], "quat": [0.9, 0.1, -0.3, 0.2]},
    {"geoms": [{"type": "sphere", "size": [0.012], "pos": [0, 0, 0.02]}, {"type": "box", "size": [0.01, 0.01, 0.02]}]},
    {"geoms": [{"type": "capsule", "size": [0.01, 0.02]}, {"type": "box", "size": [0.02, 0.01, 0.005], "pos": [0, 0, 0.03]}]},
]
"""Single and compound, on and off the body's frame: some share geoms of a shape, others lack them."""
SENSORS = {
    "force": {"kind": "kinematic_taxel"},
    "depth": {"kind": "contact_depth", "gate": "geometric"},
    "range": {"kind": "surface_distance", "max_range": 0.05, "nearest": True},
}


def mjcf(item: str) -> str:
    return (
        '<mujoco><asset><mesh name="cone" file="cone.stl"/><mesh name="ball" file="ball.stl" scale=".001 .001 .001"/></asset>'
        '<worldbody><body name="pad"><freejoint/><geom size=".05"/></body><body name="floor" pos="0 0 -1"><geom type="plane" '
        f'size="1 1 .1"/></body><body name="item"><freejoint/>{item}</body></worldbody></mujoco>'
    )


def geom(variant) -> str:
    """Return a variant as a geom of the scene."""
    if "geoms" in variant:
        return "".join(geom(part) for part in variant["geoms"])
    size = f'size="{" ".join(map(str, variant["size"]))}" type="{variant["type"]}"' if "size" in variant else ""
    mesh = f'type="mesh" mesh="{variant["mesh"].removesuffix(".stl")}"' if "mesh" in variant else ""
    pose = "".join(f' {key}="{" ".join(map(str, variant[key]))}"' for key in ("pos", "quat") if key in variant)
    return f"<geom {size}{mesh}{pose}/>"


def document(folder, item: str, sensors=SENSORS, **target):
    rng = np.random.default_rng(3)
    trimesh.creation.cone(0.015, 0.04, sections=24).export(folder / "cone.stl")
    trimesh.creation.icosphere(subdivisions=3, radius=18.0).export(folder / "ball.stl")
    (folder / "scene.xml").write_text(mjcf(item))
    points = [
        {"pos": p.tolist(), "normal": [0, 0, 1], "radius": r}
        for p, r in zip(rng.normal(scale=0.02, size=(40, 3)), rng.uniform(0, 0.01, 40), strict=True)
    ]
    return {
        "tgdsl": 1,
        "robot": {
            "model": str(folder / "scene.xml"),
            "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
        },
        "objects": {"item": {"body": "item", **placed(target, folder)}, "floor": {"body": "floor"}},
        "sensors": {name: {"links": "pad", "feels": ["item", "floor"], **spec} for name, spec in sensors.items()},
    }


def placed(value, folder):
    """Return the same with mesh files' names as paths in a folder."""
    if isinstance(value, dict):
        return {k: str(folder / v) if k == "mesh" else placed(v, folder) for k, v in value.items()}
    return [placed(part, folder) for part in value] if isinstance(value, list) else value


def one_env(state: SceneState, env: int, names) -> SceneState:
    return SceneState(**{name: getattr(state, name)[env : env + 1] for name in names})


def single_runs(folder, variants, state, **target):
    """Return the readings of each environment from a module whose scene has just its variant."""
    readings = []
    for env in range(state.body_pos.shape[0]):
        variant = variants[int(state.variant[env, 0])]
        alone = tgdsl.compile(document(folder, geom(variant), **target), dtype=torch.float64)
        assert not alone.inputs.objects
        readings.append(alone(one_env(state, env, alone.inputs.fields)))
    return {name: torch.cat([reading[name] for reading in readings]) for name in readings[0]}


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.mark.parametrize("variants", [[BOXES[0], BOXES[13], CYLINDERS[1]], ODD], ids=["alone", "compound"])
def test_a_batch_of_variants_equals_single_runs(tmp_path, variants):
    touch = tgdsl.compile(document(tmp_path, "<geom size='.01'/>", variants=variants), dtype=torch.float64)
    assert touch.inputs.objects == ("item",) and touch.inputs.num_variants == (len(variants),)
    state = touch.example_state(len(variants), spread=0.01)
    readings, expected = touch(state), single_runs(tmp_path, variants, state)
    assert readings["depth"].amax() > 0.005
    for name, value in expected.items():
        torch.testing.assert_close(readings[name], value, rtol=1e-12, atol=1e-14, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("target", [{"query": "sdf", "tolerance": 2e-4}, {"query": "raycast"}], ids=["sdf", "raycast"])
def test_meshes_among_the_variants(tmp_path, target):
    variants = [
        {"mesh": "cone.stl"},
        {"type": "box", "size": [0.02, 0.015, 0.01]},
        {"mesh": "ball.stl", "scale": 0.001, "pos": [0.003, 0, 0.01], "quat": [0.8, 0.6, 0, 0]},
        {"geoms": [{"mesh": "cone.stl", "pos": [0, 0, 0.02]}, {"mesh": "cone.stl", "quat": [0, 1, 0, 0]}]},
    ]
    touch = tgdsl.compile(document(tmp_path, "<geom size='.01'/>", variants=variants, **target), dtype=torch.float64)
    state = touch.example_state(len(variants), spread=0.01)
    readings, expected = touch(state), single_runs(tmp_path, variants, state, **target)
    assert readings["depth"].amax() > 0.005
    for name, value in expected.items():
        torch.testing.assert_close(readings[name], value, rtol=1e-9, atol=1e-12, msg=lambda m, n=name: f"{n}: {m}")
    tgdsl.save(touch, tmp_path / "a.safetensors")
    loaded = tgdsl.load(tmp_path / "a.safetensors", dtype=torch.float64)
    torch.testing.assert_close(loaded(state)["force"], readings["force"], rtol=0, atol=0)
    sim = tgdsl.simulate(loaded, 4)
    sim.step()
    assert loaded(sim.state())["depth"].shape == (4, 40, 1)


@pytest.mark.parametrize("size", ["fixed", "per_env"])
def test_variants_and_sizes_against_the_reference(tmp_path, size):
    """Also with a size per environment, for boxes and cylinders."""
    variants = ODD if size == "fixed" else [BOXES[0], CYLINDERS[0], {"type": "ellipsoid", "size": [0.01, 0.02, 0.03]}]
    sensors = {"s": {"kind": "kinematic_taxel", "gate": "geometric"}}
    doc = document(tmp_path, "<geom size='.01'/>", sensors, variants=variants, size=size)
    touch = TactileModule(compile_document(doc).plan, dtype=torch.float64)
    assert ("object_size" in touch.inputs.fields) == (size == "per_env")
    kind = next(kind for kind in KINDS if kind.name == "kinematic_taxel")
    reference = ReferenceModule(touch.plan, kind, kind.spec.model_validate({**doc["sensors"]["s"]}))
    state = touch.example_state(6, spread=0.01)
    assert_agrees(touch(state)["s"], reference, state, FLOAT64_TOLERANCE)


def test_sizes_per_environment(tmp_path):
    """A geom with a size from the state reads like a fixed one of that size, and has derivatives."""
    doc = document(tmp_path, '<geom type="box" size=".01 .01 .01"/>', size="per_env")
    touch = tgdsl.compile(doc, dtype=torch.float64)
    assert "variant" not in touch.inputs.fields
    state = touch.example_state(3, spread=0.01)
    readings = touch(state)
    for env, size in enumerate(state.object_size[:, 0].tolist()):
        alone = tgdsl.compile(document(tmp_path, geom({"type": "box", "size": size})), dtype=torch.float64)
        expected = alone(one_env(state, env, alone.inputs.fields))
        for name, value in expected.items():
            torch.testing.assert_close(readings[name][env : env + 1], value, rtol=1e-12, atol=1e-14)

    def depth(sizes):
        state.object_size = sizes
        return touch(state)["depth"]

    assert torch.autograd.gradcheck(depth, state.object_size.clone().requires_grad_(), eps=1e-7, atol=1e-5)


@pytest.mark.slow
def test_one_compiled_graph_serves_all_variants(tmp_path):
    touch = tgdsl.compile(document(tmp_path, "<geom size='.01'/>", variants=PAPER), dtype=torch.float64)
    fused = TactileModule(touch.plan, dtype=torch.float64).compile(backend="eager")
    torch.compiler.reset()
    counters.clear()
    for num_envs in (16, 48):
        state = touch.example_state(num_envs, spread=0.01)
        state.variant = state.variant.flip(0)
        readings, expected = fused(state), touch(state)
        for name, value in expected.items():
            torch.testing.assert_close(readings[name], value, rtol=1e-9, atol=1e-12)
    assert counters["stats"]["unique_graphs"] == 1 and not counters["graph_break"]


SAG = 1.2e-4
"""How far MuJoCo's soft contacts yield at rest [m], whatever the mass."""
FALL = (
    '<mujoco><option timestep=".002"/><worldbody><body name="pad"><geom type="box" size="1 1 .1" pos="0 0 -.1"/></body>'
    '<body name="item" pos="0 0 .05"><freejoint/>{}</body></worldbody></mujoco>'
)


def falling(folder, item, **target):
    (folder / "fall.xml").write_text(FALL.format(item))
    points = {"method": "points", "points": [{"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": 0.004}]}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "fall.xml"), "layout": {"resolutions": {"r": {"pad": points}}}},
            "objects": {"item": {"body": "item", **target}},
            "sensors": {"s": {"kind": "contact_depth", "links": "pad", "feels": ["item"]}},
        },
        dtype=torch.float64,
    )


def test_the_simulator_has_the_same_objects_as_the_module(tmp_path):
    """Boxes and cylinders fall on a plate with a probe: each rests at its own height, as it does alone."""
    touch = falling(tmp_path, '<geom size=".01" friction=".7"/>', variants=PAPER)
    sim = tgdsl.simulate(touch, 18, substeps=4)
    np.testing.assert_array_equal(sim.state().variant[:, 0], np.arange(18) % 16)
    for _ in range(100):
        sim.step()
    state = sim.state()
    height = np.array([PAPER[i % 16]["size"][-1] for i in range(18)])
    np.testing.assert_allclose(state.body_pos[:, touch.inputs.bodies.index("item"), 2], height, atol=SAG)
    np.testing.assert_allclose(touch(state)["s"][:, 0, 0], 0.004, atol=SAG)
    for env in (3, 15):
        variant = PAPER[env]
        alone = falling(tmp_path, geom(variant).replace("/>", ' friction=".7"/>'))
        single = tgdsl.simulate(alone, 1, substeps=4)
        for _ in range(100):
            single.step()
        np.testing.assert_allclose(sim.batch.qpos[env], single.batch.qpos[0], rtol=0, atol=1e-12)
        assert single.model.body("item").mass[0] == pytest.approx(sim.batch.get_model(env).body("item").mass[0], rel=1e-12)
    assert sim.batch.get_model(3).geom_friction[-1, 0] == 0.7


def test_variants_may_have_other_centres_of_mass(tmp_path):
    """MuJoCo lays out data of such bodies differently; all environments still run together."""
    touch = falling(tmp_path, '<geom size=".01"/>', variants=[BOXES[0], ODD[3], ODD[1]])
    sim = tgdsl.simulate(touch, 3, substeps=4)
    for _ in range(200):
        sim.step()
    assert np.isfinite(sim.batch.qpos).all() and (sim.batch.qpos[:, 2] > 0).all()
    assert sim.batch.qpos[0, 2] == pytest.approx(BOXES[0]["size"][2], abs=SAG)
    for env, variant in enumerate((BOXES[0], ODD[3], ODD[1])):
        alone = tgdsl.simulate(falling(tmp_path, geom(variant)), 1).model
        body, variant_model = alone.body("item").id, sim.batch.get_model(env)
        np.testing.assert_allclose(variant_model.body_mass[body], alone.body_mass[body], rtol=1e-12)
        np.testing.assert_allclose(variant_model.body_inertia[body], alone.body_inertia[body], rtol=1e-9)
        np.testing.assert_allclose(variant_model.body_ipos[body], alone.body_ipos[body], atol=2.1e-6)


def test_sizes_and_variants_can_be_changed(tmp_path):
    touch = falling(tmp_path, '<geom type="box" size=".01 .01 .01"/>', size="per_env")
    sim = tgdsl.simulate(touch, 3, substeps=4)
    np.testing.assert_array_equal(sim.state().object_size[:, 0], np.full((3, 3), 0.01))
    sim.set_objects(sizes={"item": [[0.01, 0.02, 0.03], [0.02, 0.02, 0.015]]}, env_ids=[0, 2])
    np.testing.assert_array_equal(sim.state().object_size[:, 0], [[0.01, 0.02, 0.03], [0.01] * 3, [0.02, 0.02, 0.015]])
    for _ in range(100):
        sim.step()
    np.testing.assert_allclose(sim.batch.qpos[:, 2], [0.03, 0.01, 0.015], atol=SAG)
    assert sim.batch.get_model(0).body("item").mass[0] == pytest.approx(1000 * 8 * 6e-6)
    both = falling(tmp_path, '<geom size=".01"/>', variants=[BOXES[0], CYLINDERS[0]], size="per_env")
    sim = tgdsl.simulate(both, 4)
    sim.set_objects(variants={"item": [0, 1, 1, 0]}, sizes={"item": [0.012, 0.03, 0.02]})
    np.testing.assert_array_equal(sim.state().variant[:, 0], [0, 1, 1, 0])
    np.testing.assert_array_equal(sim.state().object_size[:, 0], [[0.012, 0.03, 0.02 * (v == 0)] for v in (0, 1, 1, 0)])
    for bad, message in (
        ({"variants": {"item": 2}}, "variants of object item: expected 4 integers from 0 to 1, found 2"),
        ({"variants": {"item": [0, 1]}}, r"expected 4 integers from 0 to 1, found \[0, 1\]"),
        ({"sizes": {"item": [0.01]}}, r"size of object item is \[0.01\], expected 3 positive lengths"),
        ({"variants": {"itme": 0}}, 'no object "itme" differs between environments; did you mean "item"'),
        ({"variants": {"item": 0}, "env_ids": [7]}, "env_ids: found 7, expected indices from 0 to 3, or a mask of 4"),
    ):
        with pytest.raises(SimulationError, match=message):
            sim.set_objects(**bad)
    np.testing.assert_array_equal(sim.state().variant[:, 0], [0, 1, 1, 0])


def test_invalid_variants_in_a_state_are_refused(tmp_path):
    touch = tgdsl.compile(document(tmp_path, "<geom size='.01'/>", variants=ODD))
    state = touch.example_state(4)
    assert touch(state.to(torch.float32))["depth"].shape == (4, 40, 1)
    state.variant[2, 0] = 4
    with pytest.raises(StateError, match=r"SceneState\.variant of object item is 4, expected 0 to 3"):
        touch(state)
    state.variant = state.variant.double()
    with pytest.raises(StateError, match=r"SceneState\.variant is torch\.float64, expected torch\.int64 or torch\.int32"):
        touch(state)
    state.variant = None
    with pytest.raises(StateError, match="SceneState lacks variant, which this module reads"):
        touch(state)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ({"variants": []}, "objects.item.variants: found a list of 0, expected at least 1 entry"),
        ({"variants": [{"type": "box", "size": [0.01]}]}, "objects.item.variants[0]: a box has 3 sizes, found 1"),
        ({"variants": [{"type": "cube", "size": [0.01]}]}, "objects.item.variants[0].type: found \"cube\", expected 'sphere'"),
        ({"variants": [{"mesh": "cones.stl"}]}, 'objects.item.variants[0]: there is no file "'),
        (
            {"variants": [{"mesh": "cone.stl", "scale": 0}]},
            "objects.item.variants[0].scale: 0 is out of range, expected more than 0",
        ),
        ({"variants": [{"type": "sphere", "size": ["1 kg"]}]}, "objects.item.variants[0].size[0]: "),
        ({"variants": [{"geoms": [{"type": "sphere"}]}]}, 'objects.item.variants[0].geoms[0]: missing key "size"'),
        ({"variants": [{"type": "sphere", "size": [0.01], "quat": [0, 0, 0, 0]}]}, "is no orientation"),
        (
            {"variants": ODD, "surface": "skin"},
            'surface "skin" names a geom; with `geom` or `variants`: `collision` or `visual`',
        ),
        ({"variants": ODD, "size": "per_env"}, "has one geom, a primitive; found sphere, box; primitives: sphere"),
        ({"variants": ODD, "body": "pad"}, 'body "pad" carries taxels, so its geoms cannot be others'),
        ({"size": "per_env", "body": "floor"}, 'the geoms of body "floor" are this object'),
    ],
)
def test_invalid_variants_are_refused(tmp_path, target, message):
    with pytest.raises(SpecError) as error:
        tgdsl.compile(document(tmp_path, "<geom size='.01'/>", **target))
    assert message in str(error.value), str(error.value)
    assert len(error.value.problems) == 1, str(error.value)


def test_geoms_of_variants_are_aligned_in_order():
    columns, tables = aligned([["box"], ["sphere", "box"], ["box", "box"], []])
    assert columns == ("box", "sphere", "box")
    assert tables == [[0, None, None], [None, 0, 1], [0, None, 1], [None, None, None]]


def test_the_same_document_gives_the_same_plan(tmp_path):
    first, second = (compile_document(document(tmp_path, "<geom size='.01'/>", variants=ODD)).plan for _ in range(2))
    assert first.to_json() == second.to_json() and json.loads(first.to_json())["scene"]["objects"][0]["name"] == "item"


def test_unused_models_are_dropped(tmp_path):
    touch = falling(tmp_path, '<geom type="box" size=".01 .01 .01"/>', size="per_env")
    sim = tgdsl.simulate(touch, 4)
    rng = np.random.default_rng(0)
    for _ in range(5):
        sim.set_objects(sizes={"item": rng.uniform(0.01, 0.02, (4, 3))})
    scenes = sim._objects.scenes
    assert len(scenes._models) == 4
    sim.step()
    assert np.isfinite(sim.batch.qpos).all()
