import copy
import pickle
import warnings
from typing import Literal

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError, StateError, TgdslError
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.sensors import KINDS
from tgdsl.sensors.base import Channel, ContactProbeSpec, Kind, Lowered

SCENE = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01"/></body>
  <body name="tip" pos=".1 0 0"><geom type="sphere" size=".01"/></body>
  <body name="item" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  <body name="far" pos="1 0 0"><freejoint/><geom type="sphere" size=".02"/></body>
</worldbody></mujoco>
"""


@pytest.fixture
def document(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    grid = {"method": "grid", "rows": 3, "columns": 4, "direction": [0, 0, -1], "radius": 0.004}
    ball = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.003}]}
    sensor = {"links": "flat", "feels": ["item"]}
    return {
        "tgdsl": 1,
        "robot": {
            "model": str(tmp_path / "scene.xml"),
            "layout": {"groups": {"flat": "pad", "all": ["flat", "tip"]}, "resolutions": {"r": {"pad": grid, "tip": ball}}},
        },
        "objects": {"item": {"body": "item"}, "far": {"body": "far"}},
        "sensors": {
            "touch": {"kind": "kinematic_taxel", "readout": "both", **sensor},
            "contact": {"kind": "contact", "release_threshold": "0.1 mm", **sensor},
        },
    }


@pytest.fixture
def touch(document):
    return tgdsl.compile(document)


def test_missing_and_misshapen_fields_are_named(touch):
    good = touch.example_state(3)
    table = [
        ({"body_quat": None}, "SceneState lacks body_quat, which this module reads"),
        ({"body_pos": None, "body_quat": None}, "SceneState lacks body_pos, body_quat, which this module reads"),
        ({"body_pos": good.body_pos[:, :1]}, "SceneState.body_pos has shape (3, 1, 3), expected (env, 2, 3); body: item, pad"),
        ({"body_quat": good.body_quat[:2]}, "SceneState.body_quat holds 2 environments, body_pos 3"),
        (
            {"contact_found": good.contact_found[:, 0]},
            "SceneState.contact_found has shape (3,), expected (env, 1); pair: pad – item",
        ),
        ({"body_pos": good.body_pos.half()}, "SceneState.body_pos is torch.float16, expected torch.float32 or torch.float64"),
        ({"body_pos": good.body_pos.to("meta")}, "SceneState.body_pos is on meta, the module on cpu"),
    ]
    for change, message in table:
        state = copy.copy(good)
        for name, value in change.items():
            setattr(state, name, value)
        with pytest.raises(StateError) as caught:
            touch(state)
        assert str(caught.value) == message


def test_a_pose_that_is_not_finite_is_warned_of_once(touch):
    state = touch.example_state(4)
    state.body_quat[2, 1, 0] = torch.nan
    with pytest.warns(
        UserWarning, match="not finite in environments 2: what depends on them is read as not-a-number"
    ) as caught:
        readings = touch(state)
    assert caught[0].filename == __file__
    assert [bool(reading.isnan().any()) for reading in readings["touch"]] == [False, False, True, False]
    touch(state)  # warnings are errors


def test_unwanted_fields_are_ignored(touch):
    state = touch.example_state(2)
    expected = touch(state)["touch"]
    state.contact_netforce = torch.zeros(7)
    torch.testing.assert_close(touch(state)["touch"], expected, rtol=0, atol=0)


def test_contacts_may_be_boolean_or_counts(touch):
    state = touch.example_state(4)
    counts = torch.tensor([[0.0], [1.0], [4.0], [0.0]])
    readings = []
    for values in (counts, counts > 0, counts.int()):
        state.contact_found = values
        touch.reset()
        readings.append(touch(state)["touch"])
    torch.testing.assert_close(readings[0], readings[1], rtol=0, atol=0)
    torch.testing.assert_close(readings[0], readings[2], rtol=0, atol=0)


def test_outputs_and_taxels_describe_the_readings(touch):
    readings = touch(touch.example_state(5))
    assert {output.name: (5, *output.shape) for output in touch.outputs} == {k: tuple(v.shape) for k, v in readings.items()}
    first = touch.outputs[0]
    assert (first.name, first.kind, first.channels[:4]) == (
        "touch",
        "kinematic_taxel",
        ("force_x", "force_y", "force_z", "torque_x"),
    )
    assert first.units == ("N",) * 3 + ("N·m",) * 3
    table = touch.taxels["touch"]
    assert list(table.dtype.names) == ["link", "body", "pos", "normal", "tangent", "radius", "area", "row", "column", "groups"]
    assert set(table["link"]) == {"pad"} and set(table["groups"]) == {"all,flat"}
    np.testing.assert_allclose(table["pos"][:, 2], 0.01)
    assert [tuple(cell) for cell in zip(table["row"], table["column"], strict=True)] == [
        (r, c) for r in range(3) for c in range(4)
    ]


def test_rows_per_body_name_their_links(document):
    document["sensors"] = {"load": {"kind": "link_contact", "links": "all", "feels": ["item"]}}
    touch = tgdsl.compile(document)
    assert touch.outputs[0].rows == "body" and touch.outputs[0].shape == (2, 4)
    table = touch.rows["load"]
    assert table["body"].tolist() == ["pad", "tip"] == table["links"].tolist()
    assert len(touch.taxels["load"]) == 13  # taxels on its links, not rows


def test_readings_are_views_of_channel_major_storage(touch):
    reading = touch(touch.example_state(5))["touch"]
    assert reading.transpose(1, 2).is_contiguous()


def test_without_noise_both_readouts_are_equal(touch):
    readings = touch(touch.example_state(5))
    torch.testing.assert_close(readings["touch"], readings["touch/clean"], rtol=0, atol=0)


def test_the_plan_has_only_what_its_sensors_need(touch):
    """Links without a sensor and unfelt objects are in neither inputs nor arrays; one query serves both sensors."""
    assert touch.inputs.bodies == ("item", "pad")
    depth = touch.plan.quantities["contact_depth"]
    assert list(touch.plan.quantities) == ["contact_depth"] and len(depth.queries) == len(depth.uses) == 1
    assert not any("far" in name or "tip" in name for name in touch.plan.arrays)
    assert dict(touch.plan.dropped) == {"link tip": "no sensor is on its taxels", "object far": "no sensor feels it"}


def test_a_shared_query_costs_once(document):
    both = tgdsl.compile(document).operations_per_env()
    del document["sensors"]["contact"]
    alone = tgdsl.compile(document).operations_per_env()
    assert both - alone < 0.1 * alone


def test_explain_names_counts_inputs_and_dropped_parts(touch):
    text = touch.explain()
    for part in (
        "12 taxels",
        "link tip: no sensor is on its taxels",
        "pad – item",
        "asks for depth of 12 probes (query 0) with motion and normal in item (box), where MuJoCo has the pair in contact "
        "(found once for contact too)",
        "(found once for touch too)",
        "remembers bit",
        "contact_found",
    ):
        assert part in text
    assert f"{touch.operations_per_env()} elementary operations" in text
    assert f"{4 * 12 * (6 + 6 + 1)} bytes of readings" in text


def test_float64_constants_equal_the_plans_exactly(document):
    touch = tgdsl.compile(document)
    exact = tgdsl.compile(document, dtype=torch.float64)
    for moved in (touch.double(), tgdsl.compile(document).to(torch.float64), tgdsl.compile(document).double().float().double()):
        for (name, a), (_, b) in zip(moved.constants.named_buffers(), exact.constants.named_buffers(), strict=True):
            assert torch.equal(a, b), name
        assert moved.dtype == torch.float64
    assert touch.constants["pairs/link"].dtype == torch.int64


def test_the_tree_of_constants_has_the_buffers_also_after_a_cast(touch):
    constants = touch.double().constants
    assert constants.tree["sensors"]["touch"].normal_stiffness is constants["sensors/touch/normal_stiffness"]


def test_a_changed_constant_stays_changed(touch):
    touch.constants["sensors/touch/normal_stiffness"].fill_(123.0)
    assert touch.double().constants["sensors/touch/normal_stiffness"].item() == 123.0


def test_a_constant_overwritten_under_inference_mode_has_gradients_after_a_cast(touch):
    name = "sensors/touch/normal_stiffness"
    with torch.inference_mode():
        touch.constants.overwrite(name, np.full(touch.constants[name].shape, 123.0))
    stiffness = touch.double().constants[name].requires_grad_()
    (2 * stiffness).sum().backward()
    assert stiffness.item() == 123.0 and stiffness.grad.item() == 2.0


def test_parameters_have_gradients(document):
    touch = tgdsl.compile(document, dtype=torch.float64)
    stiffness = touch.constants["sensors/touch/normal_stiffness"].requires_grad_()
    state = touch.example_state(8)
    force = touch(state)["touch"][..., :3].sum()
    (gradient,) = torch.autograd.grad(force, stiffness)
    with torch.no_grad():
        stiffness += 1.0
        difference = touch(state)["touch"][..., :3].sum() - force
    assert gradient.item() == pytest.approx(difference.item(), rel=1e-9)


def test_calls_and_resets_work_under_inference_mode_and_after_it(touch):
    state = touch.example_state(2)
    with torch.inference_mode():
        touch(state)
        touch(state)
        touch.reset([1])
    touch(state)
    touch.reset()
    assert touch.num_envs == 2


def test_graphs_need_a_gpu(touch):
    with pytest.raises(TgdslError, match="`graph` needs a module on a GPU, this one is on cpu"):
        touch.compile(graph=True)


def test_a_module_with_state_has_a_fixed_number_of_environments(touch, document):
    assert touch.num_envs is None and touch.has_state
    touch(touch.example_state(3))
    with pytest.raises(StateError, match="this module holds the state of 3 environments, the scene has 4"):
        touch(touch.example_state(4))
    del document["sensors"]["contact"]
    stateless = tgdsl.compile(document)
    for num_envs in (1, 4, 2):
        assert stateless(stateless.example_state(num_envs))["touch"].shape[0] == num_envs
    assert stateless.num_envs is None and not stateless.state_dict()


def test_a_module_can_be_copied_and_pickled(touch):
    state = touch.example_state(2)
    expected = touch(state)["touch"]
    for other in (copy.deepcopy(touch), pickle.loads(pickle.dumps(touch))):
        torch.testing.assert_close(other(state)["touch"], expected, rtol=0, atol=0)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda touch: pickle.loads(pickle.dumps(touch))], ids=["deepcopy", "pickle"])
def test_a_copy_has_its_own_constants(document, copied):
    """A copy that is changed or cast uses its own constants; the original is unchanged."""
    touch, stiffness = tgdsl.compile(document), "sensors/touch/normal_stiffness"
    state = touch.example_state(64)
    expected = touch.peek(state)["touch"]
    assert expected.any()
    exact, other, twice = copied(touch).double(), copied(touch), copied(touch)
    twice.constants[stiffness].mul_(2)
    pointers = [buffer.data_ptr() for module in (touch, exact, other, twice) for buffer in module.constants.buffers()]
    assert len(set(pointers)) == len(pointers)
    assert torch.equal(touch.peek(state)["touch"], expected)
    assert torch.equal(exact.peek(state)["touch"], tgdsl.compile(document, dtype=torch.float64).peek(state)["touch"])
    document["sensors"]["touch"]["normal_stiffness"] = touch.constants[stiffness].item() * 2
    assert torch.equal(twice.peek(state)["touch"], tgdsl.compile(document).peek(state)["touch"])
    assert not torch.equal(twice.peek(state)["touch"], expected)
    touch.constants[stiffness].zero_()
    assert torch.equal(other.peek(state)["touch"], expected)
    assert not torch.equal(touch.peek(state)["touch"], expected)


def test_example_states_are_reproducible(touch):
    a, b, c = touch.example_state(2), touch.example_state(2), touch.example_state(2, seed=1)
    assert torch.equal(a.body_pos, b.body_pos) and not torch.equal(a.body_pos, c.body_pos)


def test_state_moves_between_dtypes(touch):
    state = touch.example_state(2).to(torch.float32)
    assert state.body_pos.dtype == torch.float32 and isinstance(state, SceneState)


class InverseSpec(ContactProbeSpec):
    """The spec of a user's kind, which reads 1 / (1 + depth)."""

    kind: Literal["inverse"]
    """The kind."""


INVERSE = Kind(
    InverseSpec,
    lower=lambda spec, layout, surface_of: Lowered(
        (Channel("inverse", "1"),), requests=(ContactDepth(spec.objects, spec.is_gated),)
    ),
    forward=lambda gathered, context, constants, state: ({"inverse": 1 / (1 + gathered[ContactDepth].depth)}, {}),
    reference=lambda spec, layout, gathered, context, state: (1 / (1 + gathered[ContactDepth].depth[:, None]), {}),
)


def test_users_kinds_compile_and_load(document, tmp_path):
    document["sensors"] = {"mine": {"kind": "inverse", "links": "pad", "feels": ["item"]}}
    with pytest.raises(SpecError, match='unknown kind "inverse"'):
        tgdsl.compile(document)
    touch = tgdsl.compile(document, kinds=[INVERSE])
    assert touch(touch.example_state(2))["mine"].shape == (2, 12, 1)
    tgdsl.save(touch, tmp_path / "mine.safetensors")
    with pytest.raises(TgdslError, match='sensor "mine" is of kind "inverse", which is neither installed nor given as `kinds`'):
        tgdsl.load(tmp_path / "mine.safetensors")
    loaded = tgdsl.load(tmp_path / "mine.safetensors", kinds=[INVERSE])
    state = touch.example_state(2)
    torch.testing.assert_close(loaded(state)["mine"], touch(state)["mine"], rtol=0, atol=0)
    assert isinstance(TactileModule(touch.plan, (*KINDS, INVERSE)), torch.nn.Module)


TILES = {
    "a depth": ({"kind": "contact_depth"}, True, False),
    "a force": ({"kind": "force_taxel"}, True, True),
    "two links": ({"kind": "contact_depth", "links": "all"}, False, False),
    "noise": ({"kind": "contact_depth", "noise": {"white_noise": 1e-4}}, False, False),
    "a velocity": ({"kind": "kinematic_taxel"}, False, False),
    "moments": ({"kind": "proximity", "backend": "points", "points": 30}, False, False),
    "frames": ({"kind": "elastomer"}, False, False),
}


@pytest.mark.parametrize("name", TILES)
def test_sensors_with_little_work_per_taxel_use_tiles(document, name):
    sensor, is_tiled, is_tuned = TILES[name]
    document["sensors"] = {"mine": {"links": "pad", "feels": ["item"], **sensor}}
    options = tgdsl.compile(document).inductor_options()
    tiles = {"triton.prefer_nd_tiling": is_tiled, "triton.enable_pdl": is_tiled, "coordinate_descent_tuning": is_tuned}
    assert options == {"assert_indirect_indexing": False, "triton.autotune_pointwise": not is_tiled} | tiles


def test_the_number_of_environments_is_the_only_dynamic_size(document):
    document["sensors"] = {
        "mine": {"links": "pad", "feels": ["item"], "kind": "contact_depth", "noise": {"read_delay": "5 ms"}}
    }
    torch.compiler.reset()  # it remembers sizes that changed between other modules
    touch, dynamic_sizes = tgdsl.compile(document), []

    def keep(graph, inputs):
        dynamic_sizes.append([size for size in inputs if isinstance(size, torch.SymInt)])
        return graph

    touch.compile(backend=keep)
    for num_envs in (5, 11):
        touch.free()
        touch(touch.example_state(num_envs))
    assert [len(sizes) for sizes in dynamic_sizes] == [1]


@pytest.mark.slow
def test_any_number_of_modules_can_be_compiled(document):
    sensor = {"kind": "contact_depth", "links": "pad", "feels": ["item"]}
    for count in (1, 2, 3):
        document["sensors"] = {f"depth{i}": sensor for i in range(count)}
        touch, plain = tgdsl.compile(document).compile(backend="eager"), tgdsl.compile(document)
        state = touch.example_state(2)
        with torch._dynamo.config.patch(recompile_limit=2):
            readings, expected = touch(state), plain(state)
        assert len(readings) == count and all(torch.equal(readings[name], expected[name]) for name in expected)


@pytest.mark.parametrize("dtype", [torch.int64, torch.float16, torch.bfloat16, torch.bool, torch.complex64])
def test_only_float32_and_float64_are_accepted(document, touch, tmp_path, dtype):
    """bfloat16 resolves 4 cm to 0.1 mm, half of the full scale of depths; an integer dtype would read zeros."""
    path = tmp_path / "touch.safetensors"
    tgdsl.save(touch, path)
    refused = pytest.raises(TgdslError, match=rf"^a module cannot be of {dtype}, expected torch\.float32 or torch\.float64; ")
    for make in (
        lambda: tgdsl.compile(document, dtype=dtype),
        lambda: tgdsl.load(path, dtype=dtype),
        lambda: TactileModule(touch.plan, dtype=dtype),
    ):
        with refused:
            make()
    if dtype not in (torch.int64, torch.bool):  # torch casts modules only to floating point or complex dtypes
        for cast in (lambda: touch.to(dtype), lambda: touch.type(dtype), lambda: torch.nn.Sequential(touch).to(dtype)):
            with warnings.catch_warnings(), refused:
                warnings.filterwarnings("ignore", "Complex modules")
                cast()
        assert {b.dtype for b in touch.buffers() if b.is_floating_point()} == {touch.dtype}


def test_a_module_can_be_cast_to_float64(touch):
    state = touch.example_state(3)
    single = touch(state)["touch"]
    touch.free()
    double = touch.double()(state)["touch"]
    assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
    torch.testing.assert_close(single.double(), double, rtol=0, atol=1e-5 * float(double.abs().max()))


def test_tables_use_no_tiles(document, tmp_path, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    wedge = '<asset><mesh name="wedge" vertex="0 -.01 0  0 .01 0  0 -.01 .04  0 .01 .04  .01 -.01 0  .01 .01 0"/></asset>'
    scene = SCENE.replace('<geom type="box" size=".02 .02 .02"/>', '<geom type="mesh" mesh="wedge"/>')
    (tmp_path / "scene.xml").write_text(scene.replace("<mujoco>", f"<mujoco>{wedge}"))
    document["sensors"] = {"mine": {"kind": "contact_depth", "links": "pad", "feels": ["item"]}}
    assert not tgdsl.compile(document).inductor_options()["triton.prefer_nd_tiling"]


def test_variants_keep_the_check_of_indices(document):
    document["objects"]["item"]["variants"] = [{"type": "sphere", "size": [0.01]}, {"type": "box", "size": [0.01, 0.01, 0.02]}]
    assert tgdsl.compile(document).inductor_options()["assert_indirect_indexing"]


def test_no_compiler_means_eager_and_a_warning(touch, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.warns(UserWarning, match=r"no C\+\+ compiler \(g\+\+, clang\+\+ or \$CXX\): the module stays eager"):
        touch.compile()
    touch(touch.example_state(2))


def test_compile_takes_inductor_options_unless_a_mode_options_or_backend_is_given(touch, monkeypatch):
    seen = []
    monkeypatch.setattr(touch.calls, "compile", lambda graph, **options: seen.append(options))
    for options in ({}, {"mode": "reduce-overhead"}, {"backend": "eager"}, {"options": {}}):
        touch.compile(**options)
    assert seen[0]["options"] == touch.inductor_options() and seen[0]["fullgraph"] and seen[0]["dynamic"]
    assert [each.get("options") for each in seen[1:]] == [None, None, {}]
