"""The compiled sensor: tensors in, tensors out.

Shapes: `env` environments, `body` bodies of `inputs.bodies`, `pair` pairs of `inputs.pairs`, `slot` contacts per pair, `object`
felt objects, `taxel` taxels of one sensor, `channel` numbers per taxel, `feature` numbers of an observation.
"""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tgdsl import observations
from tgdsl.buffers import Constants
from tgdsl.errors import StateError, TgdslError, did_you_mean
from tgdsl.example import example_state
from tgdsl.felt_objects import FeltObjects
from tgdsl.geometry.contacts import Contacts, contacts
from tgdsl.geometry.nearby import with_moments
from tgdsl.geometry.points import with_points
from tgdsl.geometry.query import Felt, FeltObject, Pairs, Probes, feel, measure, relate
from tgdsl.moment_sources import moment_sources
from tgdsl.plan import Inputs, Plan
from tgdsl.sensors import KINDS, Kind
from tgdsl.state import SceneState
from tgdsl.taxels import image_indices, taxel_table


@dataclass(frozen=True)
class Output:
    """One reading: its name, its sensor and that one's kind, its shape after `env`, and name and unit of each channel.

    Rows are the sensor's taxels (`rows` is "taxel"), or the bodies that carry it ("body"), which `bodies` lists.
    """

    name: str
    sensor: str
    kind: str
    shape: tuple[int, int]
    rows: str
    bodies: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]


class TactileModule(nn.Module):
    """All sensors of a document, for any number of environments at once.

    Calling it with a `SceneState` returns the readings by sensor name, each (env, taxel, channel). `observe` makes the
    observations of them. A module whose sensors carry state (see `num_envs`) takes the batch size of its first call, or of
    the state dict that it loads, and keeps it; one without state takes any.
    """

    def __init__(self, plan: Plan, kinds: Sequence[Kind] = KINDS, dtype: torch.dtype = torch.float32):
        """Build a module.

        Args:
            plan: What to compute.
            kinds: The kinds that the plan's sensors are of.
            dtype: Dtype of constants, state and readings.

        Raises:
            TgdslError: If the plan uses a kind that is not given.
        """
        super().__init__()
        self.plan = plan
        known = {kind.name: kind for kind in kinds}
        for sensor in plan.sensors:
            if sensor.kind not in known:
                hint = did_you_mean(sensor.kind, known, "kinds")
                raise TgdslError(f'sensor "{sensor.name}" is of kind "{sensor.kind}", which is not given; {hint}')
        self._kinds = {sensor.name: known[sensor.kind] for sensor in plan.sensors}
        self._felt_objects = FeltObjects(plan)
        unused = ("layout/", *self._felt_objects.kept)
        self.constants = Constants({k: v for k, v in plan.arrays.items() if not k.startswith(unused)}, dtype)
        self.memory = nn.Module()
        self._compiled_core: Callable[..., Any] | None = None

    @property
    def inputs(self) -> Inputs:
        """What the module reads of a scene, and in which order."""
        return self.plan.inputs

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Name, shape, channels and units of each reading."""
        return tuple(
            Output(
                reading.name,
                sensor.name,
                sensor.kind,
                (reading.num_rows, len(reading.channels)),
                reading.rows,
                self.plan.layout_of(sensor).bodies,
                reading.channels,
                reading.units,
            )
            for sensor in self.plan.sensors
            for reading in sensor.readings
        )

    @property
    def taxels(self) -> dict[str, Any]:
        """The taxels of each sensor, in the order of its readings, as tables: see `taxels.taxel_table`."""
        return {sensor.name: taxel_table(self.plan.layout_of(sensor)) for sensor in self.plan.sensors}

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the readings."""
        return next((b.dtype for b in self.constants.buffers() if b.is_floating_point()), torch.float32)

    @property
    def device(self) -> torch.device:
        """Device of the readings."""
        return next(self.constants.buffers()).device

    @property
    def has_state(self) -> bool:
        """Whether any sensor carries something from one call to the next."""
        return any(sensor.state for sensor in self.plan.sensors)

    @property
    def num_envs(self) -> int | None:
        """Number of environments whose state is held; None before the first call, or if there is no state."""
        return next((buffer.shape[0] for buffer in self.memory.buffers()), None)

    def forward(self, state: SceneState) -> dict[str, Float[Tensor, "env row channel"]]:
        """Read all sensors.

        Args:
            state: The scene, at one instant.

        Returns:
            Readings by name, as `outputs` lists them, in the module's dtype.

        Raises:
            StateError: If a field that is wanted is missing, or is not of the right shape, dtype or device.
        """
        tensors = state.checked(self.inputs, self.device)
        num_envs = tensors["body_pos"].shape[0]
        memory = self._memory_for(num_envs)
        readings, updated = (self._compiled_core or self.core)(tensors, memory)
        with torch.no_grad():
            for name, value in updated.items():
                memory[name].copy_(value)
        return readings

    def core(self, tensors: dict[str, Tensor], memory: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Compute readings and the new state: a pure function of its arguments, traceable in one graph.

        Args:
            tensors: The fields of `SceneState` that `inputs` names.
            memory: State by `sensor:name`, each (env, …).

        Returns:
            Readings by name, and the new state.
        """
        pairs = self._pairs(tensors)
        measured = sorted({o for query in self.plan.queries for o in query.objects})
        objects = {o: self._felt_objects.felt(self.plan.objects[o], self.constants, tensors) for o in measured}
        answers = [self._query(i, pairs, objects, tensors) for i in range(len(self.plan.queries))]
        readings: dict[str, Tensor] = {}
        updated: dict[str, Tensor] = {}
        for sensor in self.plan.sensors:
            felt, probes = answers[sensor.query][sensor.answer]
            own = {name: memory[f"{sensor.name}:{name}"] for name in sensor.state}
            constants = self.constants.under(f"sensors/{sensor.name}", sensor.constants)
            result, new = self._kinds[sensor.name].forward(felt, probes, constants, own)
            stacked = {r.channels: torch.stack([result[name] for name in r.channels], dim=1) for r in sensor.readings}
            readings |= {r.name: stacked[r.channels].transpose(1, 2) for r in sensor.readings}
            updated |= {f"{sensor.name}:{name}": value for name, value in new.items()}
        return readings, updated

    def observe(self, readings: Mapping[str, Tensor]) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the observation groups, each the concatenation of its terms, every term flattened channel-major."""
        num_envs = next(iter(readings.values())).shape[0]
        nothing = torch.empty((num_envs, 0), dtype=self.dtype, device=self.device)
        groups: dict[str, list[Tensor]] = {}
        for term in self.plan.observations:
            features = nothing
            if term.reading is not None:
                constants = self.constants.under(f"observations/{term.group}/{term.index}", term.constants)
                features = observations.observe(term.type, readings[term.reading], term.channels, constants)
            groups.setdefault(term.group, []).append(features)
        return {group: torch.cat(parts, dim=1) for group, parts in groups.items()}

    def images(
        self, name: str, readings: Mapping[str, Tensor]
    ) -> tuple[dict[str, Float[Tensor, "env channel row column"]], dict[str, Bool[Tensor, "row column"]]]:
        """Return a reading of taxels as one image per link, and where its pixels are taxels, for convolutions.

        Cells of a link's grid that missed its surface, and inactive probes, are 0 in the image and False in the mask. Links
        without a grid are left out.

        Args:
            name: The reading.
            readings: All readings.

        Raises:
            TgdslError: If there is no such reading, if it is not one of taxels, or none of its links has a grid.
        """
        owner = {r.name: sensor for sensor in self.plan.sensors for r in sensor.readings if r.rows == "taxel"}
        if name not in owner:
            raise TgdslError(f'there is no reading of taxels "{name}"; {did_you_mean(name, owner, "readings of taxels")}')
        by_channel = readings[name].transpose(1, 2)
        images, masks = {}, {}
        for link, index in image_indices(self.plan.layout_of(owner[name])).items():
            place = torch.from_numpy(index).to(by_channel.device)
            masks[link] = place >= 0
            images[link] = torch.where(masks[link], by_channel[:, :, place.clamp(min=0)], 0.0)
        return images, masks

    def reset(self, env_ids: Tensor | Sequence[int] | None = None) -> None:
        """Bring the state of some environments (default: all) back to rest; the others are left untouched.

        Args:
            env_ids: Indices, or a boolean mask over environments.
        """
        for sensor in self.plan.sensors:
            for name, memory in sensor.state.items():
                buffer = self.memory._buffers.get(f"{sensor.name}:{name}")
                if buffer is not None:
                    with torch.no_grad():
                        buffer[slice(None) if env_ids is None else torch.as_tensor(env_ids, device=buffer.device)] = memory.rest

    def compile(self, **options: Any) -> TactileModule:
        """Compile the core with `torch.compile` into fused kernels, in place; the first call then takes longer.

        Args:
            **options: Handed to `torch.compile`; default `fullgraph=True, dynamic=True`: one graph for every batch ≥ 2.

        Returns:
            The module.
        """
        if self.device.type == "cpu" and not _has_cpp_compiler():
            warnings.warn("no C++ compiler (g++, clang++ or $CXX) was found: the module stays eager", stacklevel=2)
            return self
        self._compiled_core = torch.compile(self.core, **{"fullgraph": True, "dynamic": True, **options})
        return self

    def example_state(
        self, num_envs: int, seed: int = 0, dtype: torch.dtype = torch.float64, spread: float = 0.03
    ) -> SceneState:
        """Return a valid random state of all wanted fields, with bodies close enough to touch.

        Args:
            num_envs: Number of environments.
            seed: Seed of the draw.
            dtype: Dtype of the tensors.
            spread: Standard deviation of the bodies' positions, and of contacts from their links [m].
        """
        return example_state(self.inputs, num_envs, seed, dtype, spread).to(self.device)

    def explain(self) -> str:
        """Return an account of what is computed, what was dropped and why, and what it costs."""
        from tgdsl.explain import explain

        return explain(self)

    def _pairs(self, tensors: dict[str, Tensor]) -> Pairs:
        gate = None
        if "contact_found" in tensors:
            found = tensors["contact_found"][:, self.constants["pairs/gate"]] > 0
            gate = torch.where(found, 0.0, -torch.inf).to(self.dtype)
        return relate(
            tensors["body_pos"],
            tensors["body_quat"],
            self.constants["pairs/link"],
            self.constants["pairs/object"],
            self.dtype,
            tensors.get("body_linvel"),
            tensors.get("body_angvel"),
            gate,
        )

    def _query(
        self, i: int, pairs: Pairs, objects: Mapping[int, FeltObject], tensors: dict[str, Tensor]
    ) -> list[tuple[Felt, Probes]]:
        """Return the answers to a query, and its probes."""
        query = self.plan.queries[i]
        x, y, z = self.constants[f"queries/{i}/pos"]
        probes = Probes((x, y, z), self.constants[f"queries/{i}/pair"])
        near = measure(pairs, probes, [objects[index] for index in query.objects])
        answers = []
        for a, answer in enumerate(query.answers):
            own = pairs if answer.is_gated else pairs._replace(gate=None)
            reach = self.constants[f"queries/{i}/{a}/reach"]
            found = self._contacts(i, a, tensors) if "contacts" in answer.needs else None
            felt = feel(own, probes, [near[o] for o in answer.objects], reach, answer.needs, found)
            if answer.moments is not None:
                sources = moment_sources(self.plan, self.constants, f"queries/{i}/{a}/moments", answer.moments, tensors)
                felt = with_moments(felt, own, probes, sources)
            if answer.points is not None:
                path = f"queries/{i}/{a}/points"
                met = self._felt_objects.point_sources(path, answer.points, self.constants, tensors)
                felt = with_points(felt, own, met)
            answers.append((felt, probes))
        return answers

    def _contacts(self, i: int, a: int, tensors: dict[str, Tensor]) -> Contacts:
        return contacts(tensors, self.constants[f"queries/{i}/bodies"], self.constants[f"queries/{i}/{a}/contacts"], self.dtype)

    def _memory_for(self, num_envs: int) -> dict[str, Tensor]:
        """Return the state buffers, allocated once, as ordinary tensors even under `torch.inference_mode`."""
        if self.has_state and self.num_envs is None:
            with torch.inference_mode(False):
                for sensor in self.plan.sensors:
                    for name, memory in sensor.state.items():
                        buffer = torch.full((num_envs, *memory.shape), memory.rest, dtype=self.dtype, device=self.device)
                        self.memory.register_buffer(f"{sensor.name}:{name}", buffer)
        if self.has_state and self.num_envs != num_envs:
            raise StateError(f"this module holds the state of {self.num_envs} environments, the scene has {num_envs}")
        return dict(self.memory.named_buffers())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Make room for the state that is loaded: before the first call there is none."""
        for sensor in self.plan.sensors:
            for name in sensor.state:
                value = state_dict.get(f"{prefix}memory.{sensor.name}:{name}")
                if isinstance(value, Tensor):
                    buffer = torch.zeros_like(value, dtype=self.dtype, device=self.device)
                    self.memory.register_buffer(f"{sensor.name}:{name}", buffer)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def _has_cpp_compiler() -> bool:
    return any(shutil.which(name) for name in (os.environ.get("CXX", ""), "g++", "clang++") if name)
