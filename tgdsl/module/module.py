"""The compiled sensor: tensors in, tensors out.

Shapes: `env` environments, `body` bodies of `inputs.bodies`, `pair` pairs of `inputs.pairs`, `slot` contacts per pair, `object`
felt objects, `taxel` taxels of one sensor, `channel` numbers per taxel, `step` calls, `feature` numbers of an observation.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.console.tables import TaxelTable, TaxelTables
from tgdsl.errors import StateError, TgdslError
from tgdsl.module.calls import Calls, cpp_compiler, inductor_options
from tgdsl.module.explain import Explained, explain, operations_per_env
from tgdsl.module.export.program import EXAMPLE_ENVS, Signature, Step, export_step, format_of
from tgdsl.module.memory import Memory, chosen_rows, last_readings, store, stored
from tgdsl.module.outputs import ObservationTerm, Output, observation_terms, observe, outputs_of
from tgdsl.module.sensing import Sensing, bind, constant_arrays, in_order, sense
from tgdsl.module.state import SHAPES, Incoming, SceneState, example_state, shape_of
from tgdsl.module.taxels import SavedTaxels, images_of, row_tables, taxel_table
from tgdsl.observations.observations import types_of
from tgdsl.plan.inputs import Inputs
from tgdsl.plan.plan import Plan
from tgdsl.sensors import KINDS, Kind
from tgdsl.sensors.known import kinds_by_sensor, quantities_of
from tgdsl.sensors.noise.pipeline import stages_of
from tgdsl.tensors.buffers import Constants
from tgdsl.tensors.devices import check_dtype, dtype_of
from tgdsl.tensors.env_ids import EnvIds, check_env_ids, env_mask
from tgdsl.tensors.torch_internals import HookedModule, fix_sizes


class TactileModule(HookedModule):
    """All sensors of a document, for any number of environments at once.

    A call with a `SceneState` returns a dictionary of readings by sensor name, each (env, taxel, channel), or (env, step,
    taxel, channel) for a sensor with `history`. `observe` computes observation groups (env, feature) from them.

    Each call advances the sensors' state: delays, filters, histories, random numbers. `peek` reads without advancing, and
    `touch(state, mask)` reads and advances only some environments. A module with state (see `num_envs`) keeps the batch size
    of its first call, or of a loaded state dict, until `free`; a module without state takes any. The default seed is 0.
    """

    def __init__(self, plan: Plan, kinds: Sequence[Kind] = KINDS, dtype: torch.dtype = torch.float32):
        """Build a module from a plan, the kinds of its sensors, and the dtype of constants, state and readings.

        Raises:
            TgdslError: If the plan uses a kind that is not given, or the dtype is another one.
        """
        super().__init__()
        self.plan = plan
        self.saved_taxels = SavedTaxels(plan)
        self._kinds = kinds_by_sensor(kinds, {sensor.name: sensor.kind for sensor in plan.sensors})
        self._quantities = tuple(quantity for quantity in quantities_of(kinds) if quantity.name in plan.quantities)
        self._observed = types_of([term.type for term in plan.observations])
        self._stages = {sensor.name: stages_of(sensor.noise.terms if sensor.noise else ()) for sensor in plan.sensors}
        self.constants = Constants(constant_arrays(plan), dtype, partial(bind, plan, self._kinds))
        self.memory = Memory(plan.sensors, plan.readings(), self._kinds)
        state = [(f"{sensor.name}:{name}", part) for sensor in plan.sensors for name, part in sensor.state.items()]
        self._overwritten = [name for name, part in state if part.overwritten]
        self.calls, self._order = Calls(), in_order(plan.sensors)
        self.incoming = Incoming(plan, self._kinds, self.constants)

    def __repr__(self) -> str:
        layout, origin = self.plan.layout, self.plan.origin
        where = f"{layout.num_taxels} taxels on {len(layout.links)} links of {origin.robot.rpartition('/')[2]}"
        return f"TactileModule({where}{origin.at_resolution}, {self.dtype}, {self.device})\n{self.outputs}"

    @property
    def inputs(self) -> Inputs:
        """The fields of a scene that the module reads, and their order."""
        return self.plan.inputs

    @cached_property
    def outputs(self) -> tuple[Output, ...]:
        """Name, shape, channels and units of each reading; a tuple that prints as a table."""
        return outputs_of(self.plan)

    @property
    def observations(self) -> dict[str, tuple[ObservationTerm, ...]]:
        """The terms of each observation group: name, type, size, and the slice of its features in the result of `observe`."""
        return observation_terms(self.plan)

    @property
    def taxels(self) -> dict[str, TaxelTable]:
        """Tables of the taxels on each sensor's links: see `taxels.taxel_table`.

        They are the rows of a reading if its `rows` in `outputs` is "taxel". A `link_contact` has one row per body instead:
        `rows` has the `body` of each row and its `links`, joined by commas.
        """
        with_taxels = [sensor for sensor in self.plan.sensors if len(sensor.taxels)]
        return TaxelTables({sensor.sensor: taxel_table(self.plan.layout_of(sensor)) for sensor in with_taxels})

    @property
    def taxels_id(self) -> str:
        """Hash of all taxels, exact to the last bit: see `tgdsl.check_taxels`."""
        return self.plan.taxels_id

    @property
    def rows(self) -> dict[str, TaxelTable]:
        """Tables of the rows of each reading: taxels as in `taxels`, bodies, or other rows that the kind defines."""
        return row_tables(self.plan)

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the readings."""
        return self.constants.dtype

    @property
    def device(self) -> torch.device:
        """Device of the readings."""
        return self.constants.device

    @property
    def has_state(self) -> bool:
        """Whether any sensor has state, which is carried from call to call."""
        return self.memory.is_wanted

    @property
    def num_envs(self) -> int | None:
        """Number of environments of the state; None before the first call, or if there is no state."""
        return self.memory.num_envs

    def forward(
        self, state: SceneState, mask: Tensor | None = None, env_ids: EnvIds | None = None
    ) -> dict[str, Float[Tensor, "env *step row channel"]]:
        """Read all sensors, and advance their state.

        With `mask` or `env_ids` only these environments are read and advanced, such as after a reset in the middle of a control
        step. The others keep delay, noise and history, and their rows repeat the last readings. A mask on the module's device
        can be captured in a CUDA graph.

        Args:
            state: The scene, at one instant.
            mask: Which environments to read, boolean (env,); default: all.
            env_ids: Indices of environments, instead of a mask.

        Returns:
            Readings of all environments by name, in the order of `outputs` and the module's dtype. They are new tensors, except
            if the module replays a CUDA graph (see `compile`), and for histories that are declared as views.

        Raises:
            StateError: If a required field is missing, or has the wrong shape, dtype or device; if there are no such
                environments, or the first call leaves some out.
        """
        tensors, num_envs = self._tensors(state)
        step = "advance"
        if mask is not None or env_ids is not None:
            step, tensors["mask"] = "advance_some", self.incoming.mask_of(mask, env_ids, num_envs, self.device)
            self.memory.keep_last(num_envs)
        else:
            self.memory.keep_no_other(num_envs)
        memory = self.memory.tensors(num_envs, state.dt, self.dtype, self.device)
        readings = self._run(step, tensors, memory)
        self.record_outputs(readings)
        return self.memory.with_views(readings)

    def record_outputs(self, readings: Mapping[str, Tensor]) -> None:
        """Keep the readings of a call, for callers that replay a captured graph of calls."""
        self.memory.cache_readings(readings)

    def peek(self, state: SceneState) -> dict[str, Float[Tensor, "env *step row channel"]]:
        """Return the readings of a call, and raise its errors, without advancing state: the next call draws the same noise."""
        tensors, num_envs = self._tensors(state)
        is_first = self.has_state and self.num_envs is None
        memory = self.memory.tensors(num_envs, state.dt, self.dtype, self.device)
        try:
            return self._run("look", tensors, memory)
        finally:
            if is_first:
                self.free()

    def initial_memory(self, num_envs: int, dt: float | None = None) -> dict[str, Tensor]:
        """Return the initial state for `step`: tensors (env, …), except those in `memory.SHARED`.

        `dt` is the shortest time between steps [s], required if `inputs.fields` has it: the length of delays follows from it.

        Raises:
            StateError: If the time is missing.
        """
        if "dt" in self.inputs.fields and dt is None:
            raise StateError("initial_memory: expected `dt`, the time between steps [s]: this module reads SceneState.dt")
        memory = Memory(self.plan.sensors, self.plan.readings())
        memory.clock.copy_seed(self.memory.clock)
        return memory.tensors(num_envs, dt, self.dtype, self.device)

    def step(
        self, state: SceneState, memory: Mapping[str, Tensor], reset: Bool[Tensor, " env"] | None = None
    ) -> tuple[dict[str, Float[Tensor, "env *step row channel"]], dict[str, Tensor]]:
        """Read all sensors as a pure function: the module's own state is neither used nor changed.

        Derivatives pass through the memory from step to step. `memory` is `initial_memory`, or the result of the last step;
        `reset` marks environments that begin an episode at this step. Returns readings by name, and the memory after the step.

        Raises:
            StateError: As for a call, or if the memory is from another module or has another number of environments.
        """
        self.constants.refresh()
        tensors = self.incoming.tensors(state, self.dtype, self.device)
        self.memory.check(memory, tensors["body_pos"].shape[0], state.dt)
        return self.pure_step(tensors, memory, reset)

    def pure_step(
        self, tensors: Mapping[str, Tensor], memory: Mapping[str, Tensor], reset: Tensor | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Do what `step` does with the fields of a state that `inputs` names, traceable in one graph."""
        old_memory = dict(memory) if reset is None else self.memory.restarted(memory, reset)
        readings, updated = self.core(dict(tensors), old_memory)
        return {name: readings[name] for name in self.plan.readings()}, stored(old_memory, updated)

    def export(
        self,
        path: str | PathLike[str],
        to: str | None = None,
        *,
        dt: float | None = None,
        state_dtype: torch.dtype | str | None = None,
        source: str = "",
        overrides: Sequence[str] = (),
    ) -> Signature:
        """Write `step` and `observe` as a file that runs without tgdsl: see docs/how-to/export.md. The module is not changed.

        The file has the module's constants, dtype, device and seed, and takes any number of environments.

        Args:
            path: The file.
            to: "pt2" (torch.export), "aoti" (AOTInductor, for C++) or "onnx"; default: by the ending .pt2, .aoti.pt2 or .onnx.
            dt: Time between steps [s], fixed in the file; default: the document's.
            state_dtype: Dtype of the state's floats; default: the module's.
            source: The document, for `tgdsl verify`.
            overrides: Overrides of the document.

        Returns:
            Names, shapes and dtypes of all inputs and outputs, in order.

        Raises:
            TgdslError: If a sensor cannot be exported, the format is unknown, or its package is not installed.
            FileError: If the file cannot be written.
        """
        file = Path(path)
        file_format = format_of(file, to)
        dt = (dt or self.inputs.dt or None) if "dt" in self.inputs.fields else None
        if "dt" in self.inputs.fields and dt is None:
            raise TgdslError("export: expected `dt`, the time between steps [s], which the document does not say")
        touch = copy.deepcopy(self)
        touch.free()
        state = replace(touch.example_state(EXAMPLE_ENVS, dtype=dtype_of(state_dtype or self.dtype)), dt=dt)
        tensors = touch.incoming.tensors(state, touch.dtype, touch.device)
        memory = touch.initial_memory(EXAMPLE_ENVS, dt)
        observed = partial(observe, touch.plan, touch.constants, types=touch._observed)
        step = Step(touch.plan, touch.constants, touch.pure_step, observed, tensors, memory, dt)
        return export_step(step, file, file_format, touch.inductor_options(), source, overrides)

    def free(self) -> None:
        """Discard all state and the number of environments; the seed stays.

        The next call may have any number of environments, and begins an episode in each.
        """
        self.memory.free()

    def _tensors(self, state: SceneState) -> tuple[dict[str, Tensor], int]:
        """Return the required fields of a state, and the number of environments."""
        self.constants.refresh()
        tensors = self.incoming.tensors(state, self.dtype, self.device)
        num_envs, held = tensors["body_pos"].shape[0], self.num_envs
        if held not in (None, num_envs):
            problem = f"this module holds the state of {held} environments, the scene has {num_envs}"
            raise StateError(f"{problem}; `free()` lets go of it")
        return tensors, num_envs

    def _run(self, name: str, tensors: dict[str, Tensor], memory: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the readings of `advance`, `advance_some` or `look`, eager, compiled or replayed: see `compile`."""
        result = self.calls.of(getattr(self, name))(tensors, memory)
        return {name: result[name] for name in self.plan.readings()}

    def advance(self, tensors: dict[str, Tensor], memory: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the readings of `core`, and replace the old state with the new one."""
        readings, updated = self._read(tensors, memory)
        store(memory, updated | last_readings(readings, memory))
        return readings

    def advance_some(self, tensors: dict[str, Tensor], memory: dict[str, Tensor]) -> dict[str, Tensor]:
        """Advance the environments of `tensors["mask"]`; return their readings, and the last readings of the others."""
        readings, updated = chosen_rows(tensors["mask"], *self.core(tensors, memory), memory)
        store(memory, updated | last_readings(readings, memory))
        return readings

    def look(self, tensors: dict[str, Tensor], memory: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the readings of `core` without changing the state."""
        return self.core(tensors, memory)[0]

    def core(self, tensors: dict[str, Tensor], memory: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Compute readings and the new state: a pure function of its arguments, traceable in one graph.

        Args:
            tensors: The fields of `SceneState` that `inputs` names.
            memory: State by `sensor:name`, each (env, …), and the clock's.

        Returns:
            Readings by name, and signals before their noise as `<sensor>/signal`; and the new state. For a ring (env, call, …)
            that is the new entry alone, (env, …).
        """
        copies = {name: memory[name].clone() for name in self._overwritten}
        readings, updated = self._read(tensors, memory | copies)
        return readings, copies | updated

    def _read(self, tensors: dict[str, Tensor], memory: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        if torch.compiler.is_compiling():  # then loops over slots and components are unrolled
            for name in filter(SHAPES.__contains__, tensors):
                fix_sizes(tensors[name], shape_of(name, self.inputs))
            for name, planned in self.memory.planned.items():
                fix_sizes(memory[name], planned.shape)
        sensing = Sensing(self.plan, self._kinds, self._quantities, self._stages, self.memory.clock, self._order)
        return sense(sensing, self.constants.tree, tensors, memory, self.dtype)

    def observe(self, readings: Mapping[str, Tensor]) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the observation groups, each the concatenation of its terms, every term flattened channel-major.

        Raises:
            ObservationError: If an observed reading is missing or has another shape, or only the real hand has it.
        """
        self.constants.refresh()
        return observe(self.plan, self.constants, readings, self._observed)

    def images(
        self, name: str, readings: Mapping[str, Tensor]
    ) -> tuple[dict[str, Float[Tensor, "env channel row column"]], dict[str, Bool[Tensor, "row column"]]]:
        """Return the reading `name` as one image per link, for convolutions, and masks of the pixels that are taxels.

        Grid cells that miss the surface, and inactive probes, are 0 in the image and False in the mask. Links without a grid
        are left out. If calls are stacked, the image is of the last one.

        Raises:
            TgdslError: If there is no such reading, its rows are no taxels, or none of its links has a grid.
        """
        return images_of(self.plan, name, readings)

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Begin a new episode in some environments (default: all), given as indices or a mask.

        State returns to rest, filters start from the next reading's true value, and gains, dead taxels and other noise per
        episode are drawn again. Indices on a GPU are checked by an assertion in the kernel. A module without state has nothing
        to restart, and before the first call no number of environments: any index from 0 is valid then, and nothing changes.

        Raises:
            StateError: If there are no such environments.
        """
        if self.num_envs is None:
            check_env_ids(env_ids, StateError)
            return
        with torch.no_grad():
            self.memory.reset(env_mask(env_ids, self.num_envs, self.device, StateError, waits=False))

    def seed(self, seed: int, first_env: int | None = None) -> TactileModule:
        """Set the seed of noise; steps and episodes count from 0 again.

        Random numbers depend only on seed, sensor name, number of the environment, episode and step: not on other sensors or
        environments, batch size, device or process. A reset begins the next episode, so reset first, then seed.

        Args:
            seed: Any integer, modulo 2⁶⁴.
            first_env: Number of this module's first environment across all processes; default: rank times number of
                environments if torch runs distributed, else 0.

        Raises:
            TgdslError: If an argument is no integer, or `first_env` is out of range.
        """
        self.memory.clock.seed_with(seed, first_env)
        return self

    def compile(self, graph: bool = False, **options: Any) -> TactileModule:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Compile calls and `peek` with `torch.compile` into fused kernels, in place, at the first call.

        Args:
            graph: Whether calls without derivatives (under `torch.no_grad` or `inference_mode`) replay a CUDA graph. Each call
                then overwrites the readings of the last one: copy them to keep them.
            **options: Options of `torch.compile`; default `fullgraph=True, dynamic=True`, one graph for all batches ≥ 2, and
                `options=inductor_options()`.

        Raises:
            TgdslError: If `graph` is set and the module is not on a GPU.
        """
        if graph and self.device.type != "cuda":
            raise TgdslError(f"`graph` needs a module on a GPU, this one is on {self.device}")
        if self.device.type == "cpu" and cpp_compiler() is None:
            warnings.warn("found no C++ compiler (g++, clang++ or $CXX): the module stays eager", stacklevel=2)
            return self
        defaults: dict[str, Any] = {"fullgraph": True, "dynamic": True}
        if not {"mode", "options", "backend"} & options.keys():
            defaults["options"] = self.inductor_options()
        self.calls.compile(graph, **{**defaults, **options})
        return self

    def inductor_options(self) -> dict[str, Any]:
        """Return the default Inductor options of `compile`: see `calls.inductor_options`."""
        return inductor_options(self.plan, self._quantities, self.device)

    def example_state(
        self, num_envs: int, seed: int = 0, dtype: torch.dtype = torch.float64, spread: float = 0.03
    ) -> SceneState:
        """Return a random valid state with all fields of `inputs`, and bodies close enough to touch.

        `spread` is the standard deviation of the bodies' positions, and of contacts from their links [m].
        """
        return example_state(self.inputs, num_envs, seed, dtype, spread).to(self.device)

    def explain(self) -> str:
        """Return a text that lists computed and omitted quantities, with reasons and cost."""
        return explain(Explained(self.plan, self._quantities, self.constants, self.memory, self.core))

    def operations_per_env(self) -> int:
        """Return the number of elementary operations per environment, counted in an eager run."""
        return operations_per_env(Explained(self.plan, self._quantities, self.constants, self.memory, self.core))

    def on_move(self, fn: Callable[[Tensor], Tensor], move: Callable[[], object]) -> None:
        """Move or cast all tensors to float32 or float64; a captured graph has read the old ones."""
        check_dtype(fn(torch.empty(0, dtype=self.dtype, device=self.device)).dtype)
        move()
        self.calls.forget_graphs()

    def on_load(self, state_dict: dict[str, Any], prefix: str, errors: list[str], load: Callable[[], object]) -> None:
        """Load state on the module's device, also before the first call."""
        self.memory.home = self.memory.clock.home = torch.empty(0, dtype=self.dtype, device=self.device)
        load()
