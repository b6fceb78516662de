"""Reading only some environments, and peeking without advancing any state."""

import copy
import pickle

import numpy as np
import pytest
import torch
from noisy_modules import CONTACT_NOISE, EVERY_KNOB, RANGES, document, felt_state

import tgdsl
from tgdsl.errors import StateError
from tgdsl.testing import only

SENSORS = {
    "s": {"noise": EVERY_KNOB, "rate": 60, "history": {"length": 3, "reduce": "mean"}, "readout": "both"},
    "stack": {"noise": RANGES, "history": 4},
    "c": {"kind": "contact", "noise": CONTACT_NOISE, "rate": 40},
    "grip": {"kind": "elastomer", "links": "pad", "friction": 0.8},
    "points": {"kind": "elastomer", "links": "pad", "anchors": "points", "points": 40, "gate": "geometric"},
    "force": {"kind": "force_taxel"},
    "near": {"kind": "proximity", "backend": "points", "points": 50},
}
"""All kinds of memory: filters, delays, rates, windows, bits, sticking markers, held points; and sensors without memory."""
NUM_ENVS = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("some")


@pytest.fixture(scope="module")
def original(folder):
    return tgdsl.compile(document(folder, SENSORS), dtype=torch.float64)


@pytest.fixture
def touch(original):
    return copy.deepcopy(original)


def clones(readings):
    return {name: reading.clone() for name, reading in readings.items()}


def schedule(seed: int, calls: int):
    """Yield for each call the environments reset before it, those read, and whether a mask selects them."""
    rng = np.random.default_rng(seed)
    for call in range(calls):
        reset = np.flatnonzero(rng.random(NUM_ENVS) < 0.15)
        chosen = np.arange(NUM_ENVS) if call == 0 or rng.random() < 0.5 else np.flatnonzero(rng.random(NUM_ENVS) < 0.5)
        yield reset.tolist(), chosen.tolist(), bool(rng.random() < 0.5)


@pytest.fixture(params=[True, False], ids=["with_grad", "without_grad"])
def with_grad(request):
    """Run with and without gradients."""
    with torch.set_grad_enabled(request.param):
        yield request.param


@pytest.mark.parametrize(("seed", "with_grad"), [(0, True), (1, False), (2, False)], indirect=["with_grad"])
def test_each_environment_equals_a_module_of_one(touch, seed, with_grad):
    """A batch with some environments read equals single modules that are called only for their environment's reads."""
    alone = [copy.deepcopy(touch).seed(7, first_env=env) for env in range(NUM_ENVS)]
    touch.seed(7)
    last: dict[str, torch.Tensor] = {}
    for call, (reset, ids, by_mask) in enumerate(schedule(seed, 25)):
        touch.reset(reset)
        for env in reset:
            alone[env].reset()
        state = felt_state(touch, NUM_ENVS, 100 * seed + call)
        mask = torch.zeros(NUM_ENVS, dtype=torch.bool).index_fill_(0, torch.tensor(ids, dtype=torch.int64), True)
        selection = {} if len(ids) == NUM_ENVS else {"mask": mask} if by_mask else {"env_ids": ids}
        readings = touch(state, **selection)
        for env in range(NUM_ENVS):
            expected = alone[env](only(state, slice(env, env + 1))) if env in ids else None
            for name, reading in readings.items():
                if expected is None:
                    assert torch.equal(reading[env], last[name][env]), (call, env, name)
                else:
                    torch.testing.assert_close(reading[env], expected[name][0], rtol=1e-9, atol=1e-15)
        last = clones(readings)


def test_readings_are_copies(touch, with_grad):
    """Neither later calls nor writes into readings change other readings."""
    state = felt_state(touch, NUM_ENVS)
    touch(state)
    first = touch(state, env_ids=[0])
    expected = clones(first)
    for reading in touch(felt_state(touch, NUM_ENVS, 1), env_ids=[1]).values():
        reading.fill_(7.0)
    later = touch(felt_state(touch, NUM_ENVS, 2), env_ids=[2])
    assert all(torch.equal(first[name], expected[name]) for name in first)
    assert not any((reading == 7.0).all() for reading in later.values())
    assert all(torch.equal(later[name][0], expected[name][0]) for name in later)


def test_peek_advances_nothing_and_equals_the_next_call(touch):
    for call in range(6):
        state = felt_state(touch, NUM_ENVS, call)
        before = clones(touch.state_dict())
        peeks = [clones(touch.peek(state)) for _ in range(2)]
        after = touch.state_dict()
        assert before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in after)
        if call == 2:
            touch.reset([1])
            peeks = [clones(touch.peek(state))] * 2
        readings = touch(state)
        for peek in peeks:
            assert peek.keys() == readings.keys() and all(torch.equal(peek[name], readings[name]) for name in readings)
    assert touch.num_envs == NUM_ENVS


def test_peek_before_the_first_call_fixes_nothing(touch):
    touch.peek(felt_state(touch, 2))
    assert touch.num_envs is None and not touch.state_dict()
    touch(felt_state(touch, 5))
    assert touch.num_envs == 5


@pytest.mark.slow
@torch.no_grad()
def test_compiled_equals_eager(folder):
    """Rings, filters, walks, windows, held samples and bits, in three graphs: calls, masked calls and peeks."""
    noise = {"read_delay": 0.013, "hysteresis": {"strength": 0.5, "time_constant": 0.05}, "drift": 1e-5}
    sensors = {
        "s": {"kind": "contact_depth", "noise": noise, "rate": 60, "history": {"length": 3, "reduce": "mean"}},
        "c": {"kind": "contact", "release_threshold": 1e-4, "history": 3},
    }
    touch = tgdsl.compile(document(folder, sensors))
    eager, compiled = copy.deepcopy(touch).seed(3), touch.seed(3).compile(backend="eager")
    for call, (reset, ids, _) in enumerate(schedule(5, 8)):
        state = felt_state(eager, NUM_ENVS, call)
        mask = torch.zeros(NUM_ENVS, dtype=torch.bool).index_fill_(0, torch.tensor(ids, dtype=torch.int64), True)
        readings, peeks = [], []
        for module in (eager, compiled):
            module.reset(reset)
            peeks.append(clones(module.peek(state)))
            readings.append(clones(module(state) if len(ids) == NUM_ENVS else module(state, mask)))
        for a, b in (readings, peeks):
            for name in a:
                torch.testing.assert_close(b[name], a[name], rtol=1e-4, atol=1e-5 * float(a[name].abs().max()) + 1e-12)


@pytest.mark.parametrize(("keeps_last", "num_graphs"), [(False, 3), (True, 2)])
def test_with_keeps_last_calls_compile_once(folder, keeps_last, num_graphs):
    """One graph for calls and one for masked calls; without `keeps_last`, calls before the first masked one have another graph."""
    touch = tgdsl.compile(document(folder, {"d": {"kind": "contact_depth"}}))
    eager, compiled = copy.deepcopy(touch), []
    touch.memory.keeps_last = keeps_last
    touch.compile(backend=lambda graph, _: compiled.append(graph) or graph)
    mask = torch.tensor([True, False, True])
    with torch.no_grad():
        for call in range(6):
            state, selection = felt_state(touch, NUM_ENVS, call), {"mask": mask} if call % 2 else {}
            readings = touch(state, **selection)
            for name, reading in eager(state, **selection).items():
                torch.testing.assert_close(readings[name], reading)
    assert len(compiled) == num_graphs


def test_keeps_last_needs_a_whole_call_before_a_masked_one(touch):
    """Preallocated readings are empty; they follow another number of environments."""
    touch.memory.keeps_last = True
    touch.peek(felt_state(touch, NUM_ENVS))
    for num_envs in (NUM_ENVS, 2):
        with pytest.raises(StateError, match="nothing was handed out yet for the environments left out"):
            touch(felt_state(touch, num_envs), env_ids=[0])
        before = clones(touch(felt_state(touch, num_envs, 1)))
        readings = touch(felt_state(touch, num_envs, 2), env_ids=[0])
        assert all(torch.equal(readings[name][1:], before[name][1:]) for name in readings)
        touch.free()


def test_state_is_loaded_in_place(touch):
    """Captured graphs keep their tensors; another number of environments gets new ones."""
    source = copy.deepcopy(touch).seed(5)
    for call in range(3):
        source(felt_state(source, NUM_ENVS, call))
    touch.memory.keeps_last = True
    touch(felt_state(touch, NUM_ENVS, 9))
    before = {name: buffer.data_ptr() for name, buffer in touch.memory.named_buffers()}
    touch.load_state_dict(source.state_dict())
    assert {name: buffer.data_ptr() for name, buffer in touch.memory.named_buffers()} == before
    state = felt_state(touch, NUM_ENVS, 3)
    expected = clones(source(state))
    assert all(torch.equal(reading, expected[name]) for name, reading in touch(state).items())
    source.free()
    source(felt_state(source, 2))
    touch.load_state_dict(source.state_dict())
    assert touch(felt_state(touch, 2))["s"].shape[0] == 2


def test_a_sensor_without_memory_accepts_a_mask(folder, with_grad):
    touch = tgdsl.compile(document(folder, {"d": {"kind": "contact_depth"}}), dtype=torch.float64)
    states = [felt_state(touch, 4, seed) for seed in range(3)]
    first, new = clones(touch(states[0])), touch.peek(states[1])["d"]
    reading = touch(states[1], env_ids=torch.tensor([1, 3]))["d"]
    assert torch.equal(reading[[1, 3]], new[[1, 3]]) and torch.equal(reading[[0, 2]], first["d"][[0, 2]])
    larger = touch(felt_state(touch, 6, 2))["d"]  # without state, any batch is fine
    assert torch.equal(touch(felt_state(touch, 6, 3), env_ids=[])["d"], larger)
    with pytest.raises(StateError, match="readings of 6 environments were handed out before, the scene has 4"):
        touch(states[0], env_ids=[1])


def test_modified_readings_are_not_returned_again(folder):
    """Before the first masked call they are not copied, so writes into them are an error."""
    touch = tgdsl.compile(document(folder, {"d": {"kind": "contact_depth"}}), dtype=torch.float64)
    touch(felt_state(touch, 3, 0))["d"].mul_(100.0)
    with pytest.raises(StateError, match="the readings d that were handed out last have been written into since"):
        touch(felt_state(touch, 3, 1), env_ids=[1])
    first = touch(felt_state(touch, 3, 2))["d"].clone()
    reading = touch(felt_state(touch, 3, 3), env_ids=[1])["d"]
    assert torch.equal(reading[[0, 2]], first[[0, 2]])
    reading.mul_(100.0)  # from now on they are copied
    assert torch.equal(touch(felt_state(touch, 3, 4), env_ids=[1])["d"][[0, 2]], first[[0, 2]])


@pytest.mark.parametrize("change", ["load", "cast"])
def test_loading_or_casting_forgets_the_last_readings(touch, change):
    touch(felt_state(touch, NUM_ENVS))
    if change == "load":
        touch.load_state_dict(touch.state_dict())
    else:
        touch.float()
    with pytest.raises(StateError, match="nothing was handed out yet"):
        touch(felt_state(touch, NUM_ENVS), env_ids=[0])


@pytest.mark.slow
def test_a_copy_of_a_compiled_module_is_independent(folder):
    """The copy has its own constants, dtype and memory."""
    touch = tgdsl.compile(document(folder, {"d": {"kind": "kinematic_taxel", "noise": {"white_noise": 0.1}}}))
    touch.compile(backend="eager", fullgraph=False)
    state = felt_state(touch, 3)
    first = touch(state)["d"].clone()
    for other in (copy.deepcopy(touch), pickle.loads(pickle.dumps(touch))):
        exact = other.double().seed(0)
        reading = exact(state)["d"]
        assert reading.dtype == torch.float64 and other.calls.compiled.keys() == {"advance"}
        torch.testing.assert_close(reading.float(), first, rtol=1e-4, atol=1e-4)
    assert touch(state)["d"].dtype == torch.float32 and touch.memory.clock.get_buffer("step").tolist() == [2, 2, 2]


def test_state_loaded_under_inference_mode_works_outside(original):
    source, touch = copy.deepcopy(original), copy.deepcopy(original)
    for call in range(3):
        source(felt_state(source, NUM_ENVS, call))
    with torch.inference_mode():
        touch.load_state_dict(source.state_dict())
    state = felt_state(touch, NUM_ENVS, 3)
    expected = source(state)
    assert all(torch.equal(reading, expected[name]) for name, reading in touch(state).items())


def test_gradients_flow_only_from_the_environments_read(folder):
    touch = tgdsl.compile(document(folder, {"d": {"kind": "kinematic_taxel"}}), dtype=torch.float64)
    touch(felt_state(touch, 3, 0))
    state, slopes = felt_state(touch, 3, 1), []
    assert state.body_pos is not None
    state.body_pos.requires_grad_()
    for readings in (touch(state, env_ids=[1]), touch.peek(state)):
        slopes.append(torch.autograd.grad(readings["d"].square().sum(), state.body_pos)[0])
    assert torch.equal(slopes[0][1], slopes[1][1]) and slopes[1][1].abs().max() > 0
    assert not slopes[0][[0, 2]].any()


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (
            {"mask": torch.ones(4, dtype=torch.bool)},
            r"mask: found torch.bool \(4,\), expected a boolean tensor \(3,\); indices go to `env_ids`",
        ),
        ({"mask": torch.tensor([0, 1, 1])}, r"mask: found torch.int64 \(3,\), expected a boolean tensor"),
        ({"env_ids": [3]}, r"env_ids: found 3, expected indices from 0 to 2, or a mask of 3"),
        ({"env_ids": [-1]}, r"env_ids: found -1, expected indices"),
        ({"env_ids": torch.tensor([0.5])}, r"env_ids: found 0.5, expected indices"),
        (
            {"env_ids": torch.tensor([0, 1, 1], dtype=torch.uint8)},
            r"env_ids: found 0, 1, 1, expected indices from 0 to 2, or a mask",
        ),
        ({"mask": torch.ones(3, dtype=torch.bool), "env_ids": [0]}, "found both `mask` and `env_ids`, expected one of them"),
    ],
)
def test_invalid_selections_are_named_and_change_nothing(touch, chosen, message):
    state = felt_state(touch, NUM_ENVS)
    touch(state)
    before = clones(touch.state_dict())
    with pytest.raises(StateError, match=message):
        touch(state, **chosen)
    assert all(torch.equal(before[name], value) for name, value in touch.state_dict().items())


def test_reading_some_environments_needs_a_whole_call_first(touch):
    with pytest.raises(StateError, match="nothing was handed out yet for the environments left out"):
        touch(felt_state(touch, NUM_ENVS), env_ids=[0])
    assert touch.num_envs is None


# the number of environments, and loaded states


def test_free_forgets_the_batch_and_keeps_the_seed(touch):
    touch.seed(5)
    first = clones(touch(felt_state(touch, 2)))
    with pytest.raises(StateError, match=r"holds the state of 2 environments, the scene has 3; `free\(\)` lets go of it"):
        touch(felt_state(touch, 3))
    touch.free()
    assert touch.num_envs is None and not touch.state_dict()
    assert touch(felt_state(touch, 3))["s"].shape[0] == 3
    touch.free()
    assert all(torch.equal(reading, first[name]) for name, reading in touch(felt_state(touch, 2)).items())


def test_a_seed_between_calls_does_not_change_rates(folder):
    """A sensor with a rate and no delay takes a sample at every fourth call, before and after."""
    touch = tgdsl.compile(document(folder, {"d": {"kind": "contact_depth", "rate": 25}}), dtype=torch.float64)

    def sample_calls(seed):
        changes, last = [], None
        for call in range(12):
            reading = touch(felt_state(touch, 8, call))["d"]
            changes.append(last is None or not torch.equal(reading, last))
            last = reading
        touch.seed(seed)
        return changes

    assert sample_calls(1) == sample_calls(2) == [True, False, False, False] * 3


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_loaded_state_takes_the_modules_dtype(original, dtype):
    other = torch.float32 if dtype == torch.float64 else torch.float64
    touch, source = copy.deepcopy(original).to(dtype), copy.deepcopy(original).to(other).seed(3)
    for call in range(4):
        source(felt_state(source, NUM_ENVS, call))
    touch.load_state_dict(source.state_dict())
    state = felt_state(touch, NUM_ENVS, 4)
    readings, expected = touch(state), source(state)
    for name, reading in readings.items():
        assert reading.dtype == dtype
        torch.testing.assert_close(
            reading.double(), expected[name].double(), rtol=1e-3, atol=1e-4 * float(expected[name].abs().max())
        )


@pytest.mark.parametrize("missing", ["memory.clock.reset_step", "memory.s:noise/lag", "memory.history/stack"])
@pytest.mark.parametrize("strict", [True, False])
def test_an_incomplete_state_is_refused(original, missing, strict):
    source, touch = copy.deepcopy(original), copy.deepcopy(original)
    source(felt_state(source, NUM_ENVS))
    state = source.state_dict()
    del state[missing]
    with pytest.raises(RuntimeError, match=f'"{missing}" is missing, other state is there'):
        touch.load_state_dict(state, strict=strict)
    assert touch.num_envs is None
    touch(felt_state(touch, 2))


def test_state_of_another_shape_is_named(original):
    source, touch = copy.deepcopy(original), copy.deepcopy(original)
    source(felt_state(source, NUM_ENVS))
    state = source.state_dict()
    state["memory.s:noise/lag"] = state["memory.s:noise/lag"][:, :, :-1]
    state["memory.c:noise/walk"] = state["memory.c:noise/walk"][:-1]
    with pytest.raises(RuntimeError) as caught:
        touch.load_state_dict(state)
    assert '"memory.s:noise/lag" has shape (3, 6, 16), expected (env, …, 6, 17)' in str(caught.value)
    assert 'the parts of "memory." are of [2, 3] environments' in str(caught.value)


def test_an_empty_state_does_not_replace_a_state(touch):
    empty = touch.state_dict()
    touch.load_state_dict(empty)
    touch(felt_state(touch, NUM_ENVS))
    with pytest.raises(RuntimeError, match="Missing key"):
        touch.load_state_dict(empty)
