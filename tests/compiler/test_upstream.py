"""Sensors that read other sensors: evaluated in order, once, before noise; cycles are refused."""

import dataclasses
from typing import Literal

import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError, TgdslError
from tgdsl.quantities import LinkMotion
from tgdsl.sensors.base import AnySensorSpec, Axis, Channel, Kind, LinkSpec, Lowered, body_axis
from tgdsl.sensors.upstream import Upstream

SCENE = """<mujoco><worldbody><body name="a"><freejoint/><geom size=".01"/></body></worldbody></mujoco>"""
HEIGHT = frozenset({"height"})
CALLS = []


class HeightSpec(LinkSpec):
    """Height of each link."""

    kind: Literal["height"]
    """Height [m]."""


class SumSpec(AnySensorSpec):
    """Sum of other sensors."""

    kind: Literal["sum"]
    """Sum [m]."""
    of: tuple[str, ...] = ()
    """Sensors."""
    is_on_taxels = False
    needs_taxels = False


def height(gathered, context, constants, state):
    """Return heights."""
    CALLS.append("height")
    heights = gathered[LinkMotion].pos[2]
    return {"z": heights, "height": heights}, {}


def total(gathered, context, constants, state):
    """Return the sum over all rows of all sources, for others to read in turn."""
    CALLS.append("sum")
    sums = torch.cat([planes["height"] for planes in gathered[Upstream].values()], dim=1).sum(dim=1, keepdim=True)
    return {"z": sums, "height": sums}, {}


def lower_height(spec, layout, surface_of):
    """Rows are bodies."""
    return Lowered((Channel("z", "m"),), requests=(LinkMotion(),), rows=body_axis(layout), provides=HEIGHT)


def lower_sum(spec, layout, surface_of):
    """A single row."""
    request = Upstream(sensors=spec.of, planes=HEIGHT, what="height")
    return Lowered((Channel("z", "m"),), rows=Axis("sum", 1), upstream=request, provides=HEIGHT)


def undefined(spec, layout, gathered, context, state):
    """Replace a definition that no test needs."""
    raise NotImplementedError


HEIGHTS = Kind(HeightSpec, lower_height, height, undefined, provides=HEIGHT)
SUM = Kind(SumSpec, lower_sum, total, undefined, provides=HEIGHT, reads="of")


@pytest.fixture
def build(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def compiled(kinds=(HEIGHTS, SUM), only=None, **sensors):
        document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "scene.xml")}, "sensors": sensors}
        return tgdsl.compile(document, kinds=list(kinds), dtype="float64", sensors=only)

    return compiled


def test_sources_are_evaluated_first_and_once(build):
    """Readings keep the document's order, whatever it is."""
    touch = build(
        twice={"kind": "sum", "of": ["one", "h"]}, one={"kind": "sum", "of": ["h"]}, h={"kind": "height", "links": "a"}
    )
    CALLS.clear()
    state = touch.example_state(3)
    readings = touch(state)
    assert CALLS == ["height", "sum", "sum"] and list(readings) == ["twice", "one", "h"]
    torch.testing.assert_close(readings["h"][:, :, 0], state.body_pos[:, :, 2], rtol=0, atol=0)
    torch.testing.assert_close(readings["one"], readings["h"], rtol=0, atol=0)
    torch.testing.assert_close(readings["twice"], 2 * readings["h"], rtol=0, atol=0)


def test_sources_are_read_without_noise(build):
    """Noise, rate and history of a sensor affect only its own reading."""
    noisy = {"kind": "height", "links": "a", "noise": {"white_noise": 0.5}, "history": 3, "rate": 1.0}
    touch = build(one={"kind": "sum", "of": ["h"]}, h=noisy)
    for seed in range(3):
        state = touch.example_state(2, seed)
        readings = touch(state)
        torch.testing.assert_close(readings["one"][:, 0], state.body_pos[:, 0, 2:], rtol=0, atol=0)
    assert (readings["h"][:, -1, 0] - state.body_pos[:, 0, 2:]).abs().amin() > 0


def test_by_default_all_providers_are_read(build):
    h = {"kind": "height", "links": "a"}
    touch = build((HEIGHTS, dataclasses.replace(SUM, provides=frozenset(), lower=_reads_alone)), one={"kind": "sum"}, h=h, g=h)
    state = touch.example_state(2)
    torch.testing.assert_close(touch(state)["one"][:, 0], 2 * state.body_pos[:, 0, 2:], rtol=0, atol=0)


def _reads_alone(spec, layout, surface_of):
    return dataclasses.replace(lower_sum(spec, layout, surface_of), provides=frozenset())


def test_cycles_are_refused(build):
    with pytest.raises(SpecError, match=r"sensors\.one\.of: sensors read one another in a circle; one → two → one"):
        build(one={"kind": "sum", "of": ["two"]}, two={"kind": "sum", "of": ["one"]})
    with pytest.raises(SpecError, match=r"sensors\.own\.of: sensors read one another in a circle"):
        build(own={"kind": "sum", "of": ["own"]})


def test_selected_sensors_bring_their_sources(build):
    h = {"kind": "height", "links": "a"}
    touch = build(only=["twice"], twice={"kind": "sum", "of": ["one"]}, one={"kind": "sum", "of": ["h"]}, h=h, g=h)
    assert [output.name for output in touch.outputs] == ["twice", "one", "h"]


def test_a_reader_advances_as_often_as_its_sources(build):
    def block(spec, layout, surface_of):
        return dataclasses.replace(lower_height(spec, layout, surface_of), substeps=2)

    kinds = (dataclasses.replace(HEIGHTS, lower=block, knobs=frozenset()), SUM)
    with pytest.raises(
        TgdslError, match='kind "sum": it is advanced at 0 physics steps of a call, and reads "h", which is at 2'
    ):
        build(kinds, one={"kind": "sum", "of": ["h"]}, h={"kind": "height", "links": "a"})


def test_promised_planes_must_be_returned(build):
    def without(gathered, context, constants, state):
        return {"z": gathered[LinkMotion].pos[2]}, {}

    touch = build((dataclasses.replace(HEIGHTS, forward=without),), h={"kind": "height", "links": "a"})
    with pytest.raises(TgdslError, match=r"returns z, without height, which the kind provides"):
        touch(touch.example_state(1))


def test_only_planes_of_the_kind_can_be_provided(build):
    with pytest.raises(TgdslError, match='kind "height": it provides height, 0 samples of sound; expected planes of'):
        build((dataclasses.replace(HEIGHTS, provides=frozenset()),), h={"kind": "height", "links": "a"})
