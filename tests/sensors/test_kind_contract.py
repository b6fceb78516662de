"""What a kind may ask for and give: frames, contacts, surfaces, a reach of its own, reports per body, memory of any shape."""

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
from tgdsl.sensors.base import Channel, ContactProbeSpec, Lowered, Memory

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
    met, contacts = gathered[ContactDepth], gathered[Contacts]
    frame = met.frames["ball"]
    seen, *_ = planes.add(planes.rotate(frame.rotation, met.pos), frame.offset)
    calls = state["calls"] + 1
    net = {f"net_{axis}": part for axis, part in zip("xyz", contacts.net, strict=True)}
    area = constants["area"].expand_as(net["net_x"])
    planes_out = {"seen_x": seen, "depth": met.depth, "calls": calls[:, 0, :1].expand_as(seen), **net, "area": area}
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


def test_a_kind_gets_what_it_asks_for(build):
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


def test_the_reach_is_the_kinds_own(build):
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


def test_what_a_kind_refuses_is_a_located_mistake(build):
    with pytest.raises(SpecError, match=r"sensors\.s\.reach: reach -1 m is negative; expected at least 0"):
        build(reach=-1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Temperature(Request[torch.Tensor]):
    """A request that no quantity answers."""


def test_a_request_that_no_quantity_answers_is_named(build):
    asking = dataclasses.replace(KIND, lower=lambda *given: dataclasses.replace(lower(*given), requests=(Temperature(),)))
    with pytest.raises(TgdslError, match=r'^no known quantity answers the request "Temperature"; give its kind the quantity'):
        build(asking)
