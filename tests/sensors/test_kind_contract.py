"""What a kind may request and return: frames, contacts, surfaces, its own reach, reports per body, memory of any shape."""

import copy
import dataclasses
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.errors import LowerError, SpecError, TgdslError
from tgdsl.geometry import planes
from tgdsl.quantities.base import Request
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.contacts import Contacts
from tgdsl.sensors import Kind
from tgdsl.sensors.base import Axis, Channel, ContactProbeSpec, LinkSpec, Lowered, Memory

SCENE = """
<mujoco><worldbody>
  <body name="a" pos="0 0 .1"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="b"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="floor"><geom type="plane" size="1 1 .1"/></body>
  <body name="ball"><freejoint/><geom type="sphere" size=".03"/></body>
</worldbody></mujoco>
"""
POINTS = {"method": "points", "radius": 0.004, "points": [{"pos": [0.01, 0, 0.01], "normal": [0, 0, 1]}]}


class ProbeAllSpec(ContactProbeSpec):
    """Reads everything that a kind can."""

    kind: Literal["probe_all"]
    """The kind."""
    reach: float = 0.001
    """Reach [m]."""


def lower(spec, layout, surface_of):
    if spec.reach < 0:
        raise LowerError(f"reach {spec.reach:g} m is negative", field="reach", hint="expected at least 0")
    area = np.array([surface_of(link.name, ()).face_areas.sum() for link in layout.links])
    report = tuple(Channel(f"net_{axis}", "N") for axis in "xyz")
    return Lowered(
        channels=(Channel("seen_x", "m"), Channel("depth", "m"), Channel("calls", "1")),
        constants={"area": area},
        state={"calls": Memory(rest=2.0, shape=(2, 3))},
        requests=(
            ContactDepth(spec.objects, spec.is_gated, radius=np.full(layout.num_taxels, spec.reach), frame=True),
            Contacts(spec.objects, slots=3),
        ),
        reports={"net": report, "area": (Channel("area", "m²"),)},
    )


def forward(gathered, context, constants, state):
    penetration, contacts = gathered[ContactDepth], gathered[Contacts]
    frame = penetration.frames["ball"]
    seen, *_ = planes.add(planes.rotate(frame.rotation, penetration.pos), frame.offset)
    calls = state["calls"] + 1
    net = {f"net_{axis}": part for axis, part in zip("xyz", contacts.net, strict=True)}
    area = constants["area"].expand_as(net["net_x"])
    planes_out = {"seen_x": seen, "depth": penetration.depth, "calls": calls[:, 0, :1].expand_as(seen), **net, "area": area}
    assert contacts.force[0].shape[1:] == (2, 6)  # bodies, slots of two objects
    return planes_out, {"calls": calls}


KIND = Kind(ProbeAllSpec, lower, forward, reference=lambda spec, layout, gathered, context, state: (np.zeros((2, 3)), {}))


@pytest.fixture
def build(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def compiled(asking=KIND, **sensor):
        layout = {"resolutions": {"r": {"a": POINTS, "b": POINTS}}}
        document = {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": layout},
            "objects": {"floor": {"body": "floor"}, "ball": {"body": "ball"}},
            "sensors": {"s": {"kind": "probe_all", "links": "*", "feels": ["ball", "floor"], **sensor}},
        }
        return tgdsl.compile(document, kinds=[asking], dtype=torch.float64)

    return compiled


@dataclasses.dataclass(frozen=True, eq=False)
class Areas:
    """Constants of the kind with a dataclass for them."""

    area: object
    unused: object = None


def test_constants_may_be_a_dataclass(build, tmp_path):
    """The kind gets the dataclass, with None for what `lower` omits; names in plan and artefact do not change."""
    received = []

    def lower_typed(spec, layout, surface_of):
        lowered = lower(spec, layout, surface_of)
        return dataclasses.replace(lowered, constants=Areas(lowered.constants["area"]))

    def forward_typed(gathered, context, constants, state):
        received.append(constants)
        return forward(gathered, context, {"area": constants.area}, state)

    typed = Kind(ProbeAllSpec, lower_typed, forward_typed, KIND.reference, constants=Areas)
    touch, mapped = build(typed), build()
    assert touch.plan.to_json() == mapped.plan.to_json()
    assert touch.plan.arrays.keys() == mapped.plan.arrays.keys()
    state = touch.example_state(3)
    readings, expected = touch(state), mapped(state)
    assert all(torch.equal(readings[name], expected[name]) for name in expected)
    assert all(isinstance(each, Areas) and each.unused is None for each in received) and received
    tgdsl.save(touch, tmp_path / "touch.safetensors")
    loaded = tgdsl.load(tmp_path / "touch.safetensors", kinds=[typed], dtype=torch.float64)
    assert torch.equal(loaded(state)["s"], expected["s"])
    assert received[-1].area.dtype == loaded.dtype


def test_a_kind_gets_what_it_requests(build):
    touch = build()
    assert touch.inputs.slots == 3
    assert {output.name: (output.rows, output.shape) for output in touch.outputs} == {
        "s": ("taxel", (2, 3)),
        "s/net": ("body", (2, 3)),
        "s/area": ("body", (2, 1)),
    }
    assert touch.outputs[1].bodies == ("a", "b")
    state = touch.example_state(4)
    readings = touch(state)
    np.testing.assert_allclose(readings["s/area"][0, :, 0], 2 * (0.04**2 + 2 * 0.04 * 0.02) * np.ones(2), rtol=1e-12)
    names = touch.inputs.bodies
    pose = {
        b: (state.body_pos[:, i].numpy(), Rotation.from_quat(state.body_quat[:, i].numpy(), scalar_first=True))
        for i, b in enumerate(names)
    }
    for i, link in enumerate("ab"):
        world = pose[link][0] + pose[link][1].apply([0.01, 0, 0.01])
        in_ball = pose["ball"][1].inv().apply(world - pose["ball"][0])
        np.testing.assert_allclose(readings["s"][:, i, 0], in_ball[:, 0], atol=1e-15)
        total = sum(state.contact_netforce[:, p].numpy() for p, pair in enumerate(touch.inputs.pairs) if pair.link == link)
        np.testing.assert_allclose(readings["s/net"][:, i], pose[link][1].inv().apply(total), atol=1e-14)
    torch.testing.assert_close(touch(state)["s"][:, :, 2], torch.full((4, 2), 4.0, dtype=torch.float64))
    touch.reset([1])
    torch.testing.assert_close(touch(state)["s"][:, 0, 2], torch.tensor([5.0, 3, 5, 5], dtype=torch.float64))
    assert touch.state_dict()["memory.s:calls"].shape == (4, 2, 3)


def test_a_kind_sets_its_reach(build):
    """The probe of b, 10 mm above its centre, is 0.4 mm inside and 0.4 mm outside the ball of 30 mm."""
    touch = build(reach=0.001, gate="geometric")
    state = touch.example_state(2)
    state.body_quat[:] = torch.tensor([1.0, 0, 0, 0])
    state.body_pos[:] = torch.tensor([0.0, 0, 5])
    state.body_pos[:, touch.inputs.bodies.index("floor")] = 0
    height = torch.tensor([-0.0004, 0.0004], dtype=torch.float64) + 0.01 + 0.03
    state.body_pos[:, touch.inputs.bodies.index("ball")] = torch.stack(
        [torch.full_like(height, 0.01), torch.zeros_like(height), 5 + height], dim=1
    )
    np.testing.assert_allclose(touch(state)["s"][:, 1, 1], [0.0014, 0.0006], atol=1e-12)


def test_mistakes_that_a_kind_reports_name_their_field(build):
    with pytest.raises(SpecError, match=r"sensors\.s\.reach: reach -1 m is negative; expected at least 0"):
        build(reach=-1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Temperature(Request[torch.Tensor]):
    """A request that no quantity answers."""


def test_an_unanswered_request_is_named(build):
    kind = dataclasses.replace(KIND, lower=lambda *arguments: dataclasses.replace(lower(*arguments), requests=(Temperature(),)))
    with pytest.raises(TgdslError, match=r'^no known quantity answers the request "Temperature"; give its kind the quantity'):
        build(kind)


def former(felt, probes, constants, state):
    return {}, {}


def unchecked(record, **change):
    """Return a copy of a record with other values, without checks of their types."""
    record = copy.copy(record)
    for name, value in change.items():
        object.__setattr__(record, name, value)
    return record


WRONG_KINDS = {
    "`forward(felt, probes, constants, state)`, expected `forward(gathered, context, constants, state)`": {"forward": former},
    "`lower(spec, layout)`, expected `lower(spec, layout, surface_of)`": {"lower": lambda spec, layout: None},
    "`reference(spec, layout, touch, state)`, expected `reference(spec, layout, gathered, context, state)`": {
        "reference": lambda spec, layout, touch, state: None
    },
    "`quantities` is a NoneType, expected a tuple": {"quantities": None},
}


@pytest.mark.parametrize("message", WRONG_KINDS)
def test_a_kind_with_a_wrong_signature_is_refused_by_name(build, message):
    with pytest.raises(TgdslError) as error:
        build(unchecked(KIND, **WRONG_KINDS[message]))
    assert 'kind "probe_all": ' in str(error.value) and message in str(error.value)


WRONG_PARTS = {
    "rows: found 'body', expected an Axis": {"rows": "body"},
    "state \"a\": found 'points', expected `Memory`": {"state": {"a": unchecked(Memory(), shape="points")}},
    'shape of the state "a": found Temperature, expected the type of a request that the kind makes': "temperature",
    'shape of the state "a": found Contacts, expected a request whose quantity has `num_rows`': {
        "state": {"a": Memory(shape=Contacts)}
    },
    "requests: found ContactDepth, expected a tuple": {"requests": ContactDepth(("ball",))},
    "requests: found ContactDepth, expected requests, such as": {"requests": (ContactDepth,)},
    'constant "k": found float, expected a NumPy array': {"constants": {"k": 2.0}},
    'the constant "k.x" has a dot': {"constants": {"k.x": np.zeros(2)}},
    'ContactDepth is asked of "nobody", which is none of the objects': {"requests": (ContactDepth(("nobody",)),)},
    'the column "n" of its rows has 1 entries, expected one for each of 3': {"rows": Axis("voxel", 3, {"n": ["a"]})},
    "its rows are 7, each called a taxel, but the sensor has 2": {"rows": Axis("taxel", 7)},
    "`link_id` of its rows has shape (1,), expected (3,)": {"rows": Axis("voxel", 3, {}, np.zeros(1, dtype=np.int64))},
}


@pytest.mark.parametrize("message", WRONG_PARTS)
def test_invalid_parts_of_a_lowered_sensor_are_named(build, message):
    change = WRONG_PARTS[message]
    change = {"state": {"a": Memory(shape=Temperature)}} if change == "temperature" else change

    def lowered(*arguments):
        return unchecked(lower(*arguments), **change)

    with pytest.raises(TgdslError) as error:
        build(dataclasses.replace(KIND, lower=lowered))
    assert 'kind "probe_all"' in str(error.value) and message in str(error.value)


WRONG_ANSWERS = {
    "NoneType, expected planes by channel": lambda planes, state: None,
    "without the channel calls": lambda planes, state: ({n: p for n, p in planes.items() if n != "calls"}, state),
    "depth of shape (3, 1), expected 2 rows": lambda planes, state: (planes | {"depth": planes["depth"][:, :1]}, state),
    'the state "other", which `Lowered.state` does not have: calls': lambda planes, state: (planes, {"other": state["calls"]}),
    'the state "calls" of shape (3, 3), expected (3, 2, 3)': lambda planes, state: (planes, {"calls": state["calls"][:, 0]}),
}


@pytest.mark.parametrize("message", WRONG_ANSWERS)
def test_invalid_results_of_forward_are_named(build, message):
    touch = build(dataclasses.replace(KIND, forward=lambda *arguments: WRONG_ANSWERS[message](*forward(*arguments))))
    with pytest.raises(TgdslError) as error:
        touch(touch.example_state(3))
    assert 'sensor "s": `forward` of the kind "probe_all" returns' in str(error.value) and message in str(error.value)


def test_an_answer_that_was_not_requested_is_named(build):
    def lower_to_contacts(*arguments):
        return dataclasses.replace(lower(*arguments), requests=(Contacts(arguments[0].objects, slots=3),))

    touch = build(dataclasses.replace(KIND, lower=lower_to_contacts))
    with pytest.raises(TgdslError, match=r"gathered\[ContactDepth\] was not asked for.*which hold Contacts"):
        touch(touch.example_state(2))


def test_a_kind_without_constants_has_the_modules_dtype(tmp_path):
    class NothingSpec(LinkSpec):
        """Reads nothing."""

        kind: Literal["nothing"]
        """The kind."""

    def nothing(gathered, context, constants, state):
        return {"x": state["x"] + 1}, {"x": state["x"] + 1}

    def rows(spec, layout, surface_of):
        return Lowered((Channel("x", "1"),), rows=Axis("part", 2, {"name": np.array(["a", "b"])}), state={"x": Memory()})

    (tmp_path / "scene.xml").write_text(SCENE)
    robot = {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"a": POINTS}}}}
    document = {"tgdsl": 1, "robot": robot, "sensors": {"s": {"kind": "nothing", "links": "a"}}}
    kind = Kind(NothingSpec, rows, nothing, reference=lambda spec, layout, gathered, context, state: (np.zeros((2, 1)), {}))
    touch = tgdsl.compile(document, kinds=[kind], dtype="float64")
    state = touch.example_state(2)
    assert touch.rows["s"]["name"].tolist() == ["a", "b"]
    assert touch.dtype == touch(state)["s"].dtype == torch.float64
    assert touch.float().dtype == touch(state)["s"].dtype == torch.float32


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ({"crosstalk": {"strength": 0.1, "sigma": "3 mm"}}, "crosstalk mixes neighbouring taxels"),
        ({"release_threshold": "1 mm"}, "release_threshold is of a sensor with a threshold"),
    ],
)
def test_noise_that_does_not_fit_a_kinds_rows_is_a_mistake(build, noise, message):
    knobs = frozenset({"crosstalk", "release_threshold"})
    kind = unchecked(KIND, knobs=knobs, lower=lambda *arguments: dataclasses.replace(lower(*arguments), rows=Axis("voxel", 2)))
    with pytest.raises(SpecError, match=rf"sensors\.s\.noise: {message}"):
        build(kind, noise=noise)


def test_contacts_without_objects_are_refused(build):
    kind = unchecked(KIND, lower=lambda *arguments: dataclasses.replace(lower(*arguments), requests=(Contacts((), slots=3),)))
    with pytest.raises(TgdslError, match="Contacts is asked of no objects"):
        build(kind)
