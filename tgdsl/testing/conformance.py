"""The suite that kinds inherit: see `tgdsl.testing`.

Shapes: `env` environments, `taxel` taxels, `channel` numbers per taxel.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import jaxtyping
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tgdsl.compiler.pipeline import compile_document
from tgdsl.errors import UnfeltWarning
from tgdsl.module.accuracy.reference import ReferenceModule
from tgdsl.module.accuracy.states import moved, only
from tgdsl.module.artifact import load_plan, save_plan
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.plan.plan import Plan
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.schema.load import load
from tgdsl.sensors import KINDS, Kind
from tgdsl.sensors.known import quantities_of
from tgdsl.tensors.torch_internals import num_compiled_graphs
from tgdsl.testing.reference import KnownReference, answers_of, assert_agrees

FLOAT32_TOLERANCE = 1e-5
"""Largest error of a float32 module over the largest magnitude of the channel: some 80 roundings of 2⁻²⁴."""
FLOAT64_TOLERANCE = 1e-12  # the same for float64: rounding of 1e-15 times the conditioning of a thin depth
FAR_TOLERANCE = 1e-9  # the same at 1 km from the origin, where float64 positions are rounded to 1e-13 m

SCENE = """
<mujoco model="conformance">
  <worldbody>
    <body name="palm"><freejoint/><geom name="palm" type="box" size=".03 .02 .01"/></body>
    <body name="tip"><freejoint/><geom name="tip" type="sphere" size=".012"/></body>
    <body name="item"><freejoint/>
      <geom type="box" size=".02 .015 .025"/>
      <geom type="sphere" size=".015" pos=".02 .01 .03"/>
      <geom type="capsule" size=".008 .02" pos="-.02 0 -.02" euler="40 10 0"/>
    </body>
    <body name="tool"><freejoint/>
      <geom type="cylinder" size=".012 .03"/>
      <geom type="ellipsoid" size=".02 .012 .016" pos="0 0 .035" euler="0 25 70"/>
    </body>
    <body name="floor" pos="0 0 -.02"><geom type="plane" size="1 1 .1"/></body>
  </worldbody>
</mujoco>
"""
"""Two links, and objects of every primitive: on and off the body's frame, alone and compound."""


def conformance_points(num: int, seed: int) -> list[dict[str, Any]]:
    """Return probes in a link-sized ball, some of them inactive."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return [
        {"pos": (0.02 * d * rng.uniform(0.2, 1)).tolist(), "normal": d.tolist(), "radius": 0.0 if i % 7 == 3 else 0.004}
        for i, d in enumerate(directions)
    ]


def conformance_document(scene: Path, sensor: Mapping[str, Any], palm: list[Any], tip: list[Any]) -> dict[str, Any]:
    """Return a document with one sensor, `s`, on both links of the conformance scene."""
    layout = {"palm": {"method": "points", "points": palm}, "tip": {"method": "points", "points": tip}}
    return {
        "tgdsl": 1,
        "robot": {"model": str(scene), "layout": {"resolutions": {"test": layout}}},
        "objects": {name: {"body": name} for name in ("item", "tool", "floor")},
        "sensors": {"s": {"links": ["palm", "tip"], **sensor}},
    }


@functools.lru_cache(maxsize=8)
def _plan_of(document: str, kinds: tuple[Kind, ...]) -> Plan:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnfeltWarning)
        return compile_document(json.loads(document), kinds=kinds).plan


@functools.lru_cache(maxsize=8)
def _specs_of(document: str, kinds: tuple[Kind, ...]) -> Mapping[str, Any]:
    return load(json.loads(document), kinds=(*KINDS, *kinds)).spec.sensors


class KindConformance:
    """Inherit this in a test class and set `kind`, and `parameters` to test other values than the defaults."""

    kind: ClassVar[Kind]
    """The kind under test."""
    parameters: ClassVar[Mapping[str, Any]] = {}
    """Fields of the sensor other than `kind`, `links` and `feels`."""
    num_envs: ClassVar[int] = 12
    num_steps: ClassVar[int] = 3
    float32_tolerance: ClassVar[float] = FLOAT32_TOLERANCE
    float64_tolerance: ClassVar[float] = FLOAT64_TOLERANCE
    is_differentiable: ClassVar[bool] = True
    """Whether readings are differentiable in the poses, away from ties."""
    rest: ClassVar[float | tuple[float, ...]] = 0.0
    """Reading far from objects, for all channels or for each."""
    gates: ClassVar[tuple[str, ...]] = ("contact_pair", "geometric")
    """Gates that the kind supports; empty if it has none."""
    others: ClassVar[Mapping[str, tuple[Kind, Mapping[str, Any]]]] = {}
    """Sensors that it reads, by name: kind, and the other fields of the sensor."""

    @pytest.fixture
    def scene(self, tmp_path_factory: pytest.TempPathFactory) -> Path:
        """The conformance scene, as a file: the same for all tests, so that plans can be reused."""
        path = tmp_path_factory.getbasetemp() / "conformance.xml"
        path.write_text(SCENE)
        return path

    def document(self, scene: Path, **changes: Any) -> dict[str, Any]:
        """Return the document under test."""
        palm, tip = conformance_points(18, 1), conformance_points(9, 2)
        return self._with_others(conformance_document(scene, {**self.sensor(), **changes}, palm, tip))

    def _with_others(self, document: dict[str, Any]) -> dict[str, Any]:
        """Return a document with the sensors that the tested one reads, and without `links` if its kind has none."""
        if "links" not in self.kind.spec.model_fields:
            del document["sensors"]["s"]["links"]
        document["sensors"] |= {name: {"kind": kind.name, **fields} for name, (kind, fields) in self.others.items()}
        return document

    def sensor(self) -> dict[str, Any]:
        """Return the sensor under test; if it has `feels`, with all objects of the scene."""
        feels = {"feels": ["item", "tool", "floor"]} if "feels" in self.kind.spec.model_fields else {}
        return {"kind": self.kind.name, **feels, **self.parameters}

    def build(self, document: dict[str, Any], dtype: torch.dtype) -> tuple[TactileModule, ReferenceModule]:
        """Return a document's module, and its reference; plans are cached."""
        plan = _plan_of(json.dumps(document), self._extra())
        return TactileModule(plan, self._known(), dtype), self.reference(plan, document)

    def reference(self, plan: Plan, document: dict[str, Any]) -> ReferenceModule:
        """Return a document's reference."""
        specs = _specs_of(json.dumps(document), self._extra())
        upstream = {name: (kind, specs[name]) for name, (kind, _) in self.others.items()}
        return KnownReference(answers_of(type(self), json.dumps(document)), plan, self.kind, specs["s"], upstream)

    def states(self, module: TactileModule, num_envs: int | None = None) -> Iterator[SceneState]:
        """Yield the tests' states: different poses, one after the other."""
        for step in range(self.num_steps):
            yield module.example_state(num_envs or self.num_envs, seed=step)

    def _gates(self) -> list[dict[str, str]]:
        return [{"gate": gate} for gate in self.gates] or [{}]

    def _known(self) -> tuple[Kind, ...]:
        return (*KINDS, *self._extra())

    def _extra(self) -> tuple[Kind, ...]:
        return tuple(kind for kind in (self.kind, *(kind for kind, _ in self.others.values())) if kind not in KINDS)

    def test_something_is_felt(self, scene: Path) -> None:
        """The states of this suite load some taxels and leave others unloaded."""
        module, _ = self.build(self.document(scene), torch.float64)
        share = torch.stack(
            [
                (module(state)["s"] != torch.tensor(self.rest, dtype=torch.float64)).any(dim=-1).double().mean()
                for state in self.states(module)
            ]
        )
        assert 0.05 < share.mean() < 0.95, (
            f"{share.mean():.0%} of rows read something other than `rest` = {self.rest}, expected 5 % to 95 %: "
            "set `rest` to what the kind reads where nothing is near, or `parameters` so that some taxels feel and some do not"
        )

    def test_float64_equals_reference(self, scene: Path) -> None:
        """Readings are the reference's to rounding, under each gate."""
        for gate in self._gates():
            module, reference = self.build(self.document(scene, **gate), torch.float64)
            for state in self.states(module):
                assert_agrees(module(state)["s"], reference, state, self.float64_tolerance)

    def test_float32_equals_reference(self, scene: Path) -> None:
        """A float32 module with float64 poses is as accurate as float32 allows, under each gate."""
        for gate in self._gates():
            module, reference = self.build(self.document(scene, **gate), torch.float32)
            for state in self.states(module):
                readings = module(state)["s"]
                assert readings.dtype == torch.float32
                assert_agrees(readings, reference, state, self.float32_tolerance)

    @pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, FAR_TOLERANCE), (torch.float32, None)])
    @pytest.mark.parametrize("distance", [0.0, 1000.0])
    def test_rigid_motion_changes_nothing(
        self, scene: Path, dtype: torch.dtype, tolerance: float | None, distance: float
    ) -> None:
        """The moved and turned scene reads the same, also 1 km from the origin."""
        module, reference = self.build(self.document(scene), dtype)
        turn = Rotation.from_rotvec([0.3, -1.1, 0.7])
        for state in self.states(module):
            readings = module(moved(state, distance * np.array([0.6, -0.8, 0.1]), turn))["s"]
            allowed = self.float32_tolerance if tolerance is None else max(tolerance, self.float64_tolerance)
            assert_agrees(readings, reference, state, allowed)

    def test_batch_equals_singles(self, scene: Path) -> None:
        """An environment's readings do not depend on the other environments."""
        module, _ = self.build(self.document(scene), torch.float64)
        singles = [self.build(self.document(scene), torch.float64)[0].seed(0, first_env=i) for i in range(3)]
        for state in self.states(module, num_envs=3):
            together = module(state)["s"]
            alone = torch.cat([single(only(state, slice(i, i + 1)))["s"] for i, single in enumerate(singles)])
            torch.testing.assert_close(together, alone, rtol=1e-13, atol=1e-13)

    def test_taxel_permutation_commutes(self, scene: Path) -> None:
        """A permutation of the layout's taxels permutes the readings, with no other effect."""
        palm, tip = conformance_points(18, 1), conformance_points(9, 2)
        order = np.random.default_rng(3).permutation(18)
        sensor = self.sensor()
        first, _ = self.build(self._with_others(conformance_document(scene, sensor, palm, tip)), torch.float64)
        turned = conformance_document(scene, sensor, [palm[i] for i in order], tip)
        second, _ = self.build(self._with_others(turned), torch.float64)
        for state in self.states(first):
            expected = first(state)["s"]
            permuted = second(state)["s"]
            if first.outputs[0].rows != "taxel":
                torch.testing.assert_close(permuted, expected, rtol=1e-12, atol=1e-13)
                continue
            torch.testing.assert_close(permuted[:, :18], expected[:, :18][:, order], rtol=1e-13, atol=1e-13)
            torch.testing.assert_close(permuted[:, 18:], expected[:, 18:], rtol=1e-13, atol=1e-13)

    def test_no_contact_gives_the_rest_value(self, scene: Path) -> None:
        """Readings are `rest` without contact pairs and far away; inactive taxels always read `rest`."""
        for gate in self._gates():
            module, _ = self.build(self.document(scene, **gate), torch.float32)
            rest = torch.tensor(self.rest, dtype=torch.float32)
            state = module.example_state(4)
            if module.outputs[0].rows == "taxel":
                inactive = torch.from_numpy(module.taxels["s"]["radius"] == 0)
                assert inactive.any()
                self._assert_rests(module(state)["s"][..., inactive, :], rest, "inactive taxels")
            for name in ("contact_found", *SLOT_FIELDS, "contact_netforce"):
                if (value := getattr(state, name)) is not None:
                    setattr(state, name, torch.zeros_like(value))
            if state.contact_found is None:
                for part in (state, *state.substeps):
                    assert part.body_pos is not None and part.body_quat is not None
                    part.body_quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand_as(part.body_quat)
                    part.body_pos = torch.zeros_like(part.body_pos)
                    part.body_pos[:, [module.inputs.bodies.index(link) for link in ("palm", "tip")], 2] = 5.0
                state.substeps = (state,) * len(state.substeps)
            module.reset()
            self._assert_rests(module(state)["s"], rest, "where nothing is near, rows")

    def _assert_rests(self, readings: Tensor, rest: Tensor, what: str) -> None:
        """Assert that readings are the rest value to the last bit."""
        active_rows = readings[(readings != rest).any(dim=-1)]
        assert not len(active_rows), (
            f"{what} read {active_rows[0].tolist()}, expected `rest`, which is {rest.tolist()} in float32, to the last bit; "
            "where that is rounding, write `forward` so that it is exact there, such as rest * (d0 / d)"
        )

    def test_a_broken_pose_is_seen(self, scene: Path) -> None:
        """NaN in a pose gives NaN readings, not a missing contact."""
        module, _ = self.build(self.document(scene, **self._gates()[-1]), torch.float32)
        state = module.example_state(2)
        assert state.body_pos is not None
        broken = "item" if "item" in module.inputs.bodies else module.inputs.bodies[0]
        pose = state.body_pos if "item" in module.inputs.bodies else state.body_quat
        assert pose is not None
        pose[1, module.inputs.bodies.index(broken)] = torch.nan
        with pytest.warns(UserWarning, match="poses of bodies are not finite in environments 1"):
            readings = module(state)["s"]
        assert not readings[0].isnan().any()
        assert readings[1].isnan().any()

    def test_gradients_equal_finite_differences(self, scene: Path) -> None:
        """Gradients by poses and contacts match finite differences of the readings; at jumps they are finite."""
        module, _ = self.build(self.document(scene), torch.float64)
        state = module.example_state(2)
        names = [name for name in module.inputs.fields if name.startswith(("body_", "contact_")) and name != "contact_found"]
        tensors = [getattr(state, name).clone().requires_grad_() for name in names]

        def readings(*values: Tensor) -> Tensor:
            module.reset()
            changed = dict(zip(names, values, strict=True))
            if state.contact_normal is not None:  # a force that grows from nothing has a kink there, in its direction
                is_used = (state.contact_normal != 0).any(dim=-1, keepdim=True)
                changed |= {n: torch.where(is_used, changed[n], getattr(state, n)) for n in SLOT_FIELDS if n in changed}
            return module(dataclasses.replace(state, **changed))["s"]

        if self.is_differentiable:
            assert torch.autograd.gradcheck(readings, tensors, eps=1e-7, atol=1e-4, rtol=1e-4, fast_mode=True)
        total = readings(*tensors).sum()
        if total.requires_grad:
            for gradient in torch.autograd.grad(total, tensors, allow_unused=True):
                assert gradient is None or torch.isfinite(gradient).all()

    def test_gradients_of_parameters_equal_finite_differences(self, scene: Path) -> None:
        """Gradients by the kind's scalar constants match finite differences of the readings, and are finite."""
        module, _ = self.build(self.document(scene), torch.float64)
        state = module.example_state(2)
        paths = [f"sensors/s/{name}" for name in module.plan.sensors[0].constants]
        paths = [path for path in paths if module.constants[path].is_floating_point() and module.constants[path].ndim == 0]
        values = [module.constants[path].clone().requires_grad_() for path in paths]

        def readings(*changed: Tensor) -> Tensor:
            module.reset()
            for path, value in zip(paths, changed, strict=True):
                setattr(module.constants, path, value)
            return module(state)["s"]

        if self.is_differentiable and paths:
            assert torch.autograd.gradcheck(readings, values, eps=1e-7, atol=1e-4, rtol=1e-4)
        total = readings(*values).sum()
        if total.requires_grad:
            for gradient in torch.autograd.grad(total, values, allow_unused=True):
                assert gradient is None or torch.isfinite(gradient).all()

    def test_reset_of_one_environment(self, scene: Path) -> None:
        """Reset restarts one environment, by index and by mask, and leaves the others untouched."""
        module, _ = self.build(self.document(scene), torch.float64)
        other, _ = self.build(self.document(scene), torch.float64)
        first, second, *_ = self.states(module, num_envs=4)
        untouched = [module(first), module(second)][1]["s"]
        for selection in (torch.tensor([2]), torch.tensor([False, False, True, False])):
            module.reset()
            module.seed(0)  # random numbers repeat from the first call on
            module(first)
            module.reset(selection)
            readings = module(second)["s"]
            torch.testing.assert_close(readings[[0, 1, 3]], untouched[[0, 1, 3]], rtol=0, atol=0)
            other.seed(0)
            other(first)
            other.reset()
            torch.testing.assert_close(readings[2], other(second)["s"][2], rtol=0, atol=0)

    def test_plan_survives_a_file(self, scene: Path, tmp_path: Path) -> None:
        """Saving and loading a plan is the identity, and equal plans give equal bytes."""
        module, _ = self.build(self.document(scene), torch.float32)
        save_plan(module.plan, tmp_path / "a.safetensors")
        again = load_plan(tmp_path / "a.safetensors", quantities_of(self._known()))
        save_plan(again, tmp_path / "b.safetensors")
        assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
        assert again.to_json() == module.plan.to_json()
        assert all(np.array_equal(again.arrays[name], value) for name, value in module.plan.arrays.items())
        state = module.example_state(3)
        torch.testing.assert_close(TactileModule(again, self._known())(state)["s"], module(state)["s"], rtol=0, atol=0)

    def test_state_dict_goes_on_where_it_stopped(self, scene: Path) -> None:
        """A module that loads another's state dict continues with the same readings."""
        module, _ = self.build(self.document(scene), torch.float64)
        first, second, *_ = self.states(module)
        module(first)
        resumed, _ = self.build(self.document(scene), torch.float64)
        resumed.load_state_dict(module.state_dict())
        torch.testing.assert_close(resumed(second)["s"], module(second)["s"], rtol=0, atol=0)

    def test_compiled_equals_eager(self, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """One full graph gives the eager readings for every batch size, with state; no kernels are generated."""
        monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # torch.compile cannot trace run-time checks
        eager, reference = self.build(self.document(scene), torch.float32)
        torch.compiler.reset()
        num_graphs = num_compiled_graphs()
        compiled = TactileModule(eager.plan, self._known()).compile(backend="eager")
        for state in self.states(eager):
            assert_agrees(compiled(state)["s"], reference, state, self.float32_tolerance)
        other_size = eager.example_state(5, seed=9)
        at_rest, fresh = TactileModule(eager.plan, self._known()), self.reference(eager.plan, self.document(scene))
        at_rest.memory.tensors(5, other_size.dt, at_rest.dtype, at_rest.device)
        compiled.load_state_dict(at_rest.state_dict())
        assert_agrees(compiled(other_size)["s"], fresh, other_size, self.float32_tolerance)
        assert num_compiled_graphs() == num_graphs + 1
