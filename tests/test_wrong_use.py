"""Wrong arguments: each raises one of our errors, which names the value found and the one expected.

Types are not checked at run time here, as on a user's computer.
"""

import mujoco
import pytest
import torch

import tgdsl
from tgdsl.errors import FileError, RobotError, SimulationError, SpecError, StateError, TgdslError
from tgdsl.module.memory import Clock
from tgdsl.tensors.env_ids import env_mask

SCENE = """
<mujoco>
  <option timestep="0.002"><flag sleep="disable"/></option>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos="0 0 .029"><freejoint/><geom type="box" size=".02 .02 .02" mass=".25"/></body>
  </worldbody>
</mujoco>
"""
GRID = {"method": "grid", "rows": 2, "columns": 2, "direction": [0, 0, -1], "radius": 0.004}


def document(model="scene.xml", **grid):
    noise = {"like": "noisy", "read_delay": "4 ms"}
    touch = {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"], "normal_stiffness": 500, "noise": noise}
    return {
        "tgdsl": 1,
        "robot": {"model": model, "layout": {"resolutions": {"o": {"pad": {**GRID, **grid}}}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"touch": touch},
    }


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder to work in, with scenes."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "sleepy.xml").write_text(SCENE.replace('sleep="disable"', 'sleep="enable"'))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def touch(folder):
    """A module that read two environments."""
    touch = tgdsl.compile(document())
    touch(touch.example_state(2))
    return touch


WRONG = {
    "reset of one that is not there": (
        lambda touch: touch.reset([999]),
        StateError,
        "env_ids: found 999, expected indices from 0 to 1, or a mask of 2",
    ),
    "reset of one from the end": (
        lambda touch: touch.reset(torch.tensor([-1])),
        StateError,
        "env_ids: found -1, expected indices from 0 to 1, or a mask of 2",
    ),
    "reset by no index": (
        lambda touch: touch.reset([0.5]),
        StateError,
        "env_ids: found 0.5, expected indices from 0 to 1, or a mask of 2",
    ),
    "reset by a mask of another length": (
        lambda touch: touch.reset([True, False, True]),
        StateError,
        "env_ids: found a mask of 3, expected ",
    ),
    "reset by a slice": (
        lambda touch: touch.reset(slice(0, 1)),
        StateError,
        "env_ids: found slice(0, 1, None), expected indices from 0 to 1, or a mask of 2",
    ),
    "reset by a text": (
        lambda touch: touch.reset("0"),
        StateError,
        "env_ids: found '0', expected indices from 0 to 1, or a mask of 2",
    ),
    "no state": (
        lambda touch: touch(None),
        StateError,
        "a module reads a tgdsl.SceneState, found NoneType; expected sim.state(), or one that holds body_pos, ",
    ),
    "a state of another type": (
        lambda touch: touch({"body_pos": 1}),
        StateError,
        "a module reads a tgdsl.SceneState, found dict; expected ",
    ),
    "no such dtype": (
        lambda _: tgdsl.compile(document(), dtype="flaot32"),
        TgdslError,
        "dtype is 'flaot32', expected torch.float32 or torch.float64",
    ),
    "no such device": (lambda _: tgdsl.compile(document(), device="cuda:99"), TgdslError, 'there is no device "cuda:99": '),
    "physics on no such device": (
        lambda _: tgdsl.simulate(tgdsl.compile(document()), 2, device="cuda:99"),
        SimulationError,
        'there is no device "cuda:99" to run physics on: ',
    ),
    "no kind": (
        lambda _: tgdsl.compile(document(), kinds=[3]),
        TgdslError,
        "`kinds`: found int, expected a tgdsl.sensors.Kind",
    ),
    "a compiled model": (
        lambda touch: tgdsl.instrument(mujoco.MjModel.from_xml_string(SCENE), touch.inputs),
        RobotError,
        "tgdsl.instrument wants a mujoco.MjSpec, found MjModel: ",
    ),
    "no document": (lambda _: tgdsl.compile(None), TgdslError, "a document is a YAML file's name or a mapping, found NoneType"),
    "an override of the wrong type": (
        lambda _: tgdsl.compile(document(), overrides={"sensors.touch.normal_stiffness": [1]}),
        SpecError,
        "--set sensors.touch.normal_stiffness=[1]: sensors.touch.normal_stiffness: ",
    ),
    "overrides that are no mapping": (
        lambda _: tgdsl.compile(document(), overrides=["resolution=o"]),
        TgdslError,
        "overrides are a mapping from dotted paths to values, found list",
    ),
    "a folder": (lambda touch: tgdsl.save(touch, "folder"), FileError, "folder: this is a folder, expected a file's name"),
    "a folder that is not there": (
        lambda touch: tgdsl.save(touch, "none/x.safetensors"),
        FileError,
        "none/x.safetensors: No such file or directory",
    ),
    "no module": (
        lambda _: tgdsl.save("touch", "x.safetensors"),
        TgdslError,
        "tgdsl.save writes a module that tgdsl.compile returned, found str",
    ),
    "a seed that is no integer": (lambda touch: touch.seed(1.5), TgdslError, "seed is 1.5, expected an integer"),
    "an environment that is none": (
        lambda touch: touch.seed(1, first_env=2**63),
        TgdslError,
        "first_env is 9223372036854775808, expected an integer from 0 to 2**63 - 1",
    ),
    "bodies that sleep": (
        lambda _: tgdsl.simulate(tgdsl.compile(document("sleepy.xml")), 2),
        SimulationError,
        "the scene has `sleep` enabled, ",
    ),
    "environments beyond all memory": (
        lambda _: tgdsl.simulate(tgdsl.compile(document()), 10**13),
        SimulationError,
        "10000000000000 environments need about ",
    ),
    "a grid beyond all memory": (
        lambda _: tgdsl.compile(document(rows=100000, columns=100000)),
        SpecError,
        "<mapping>: robot.layout.resolutions.o.pad: 100000 × 100000 cells are too many, expected at most 1000000 in all",
    ),
}
"""A call with a module, and how its error begins."""


@pytest.mark.parametrize(("call", "kind", "message"), WRONG.values(), ids=WRONG)
def test_a_wrong_argument_is_named(touch, folder, call, kind, message):
    (folder / "folder").mkdir()
    with pytest.raises(kind) as caught:
        call(touch)
    assert type(caught.value) is kind and str(caught.value).startswith(message)


# Arguments that were refused without a reason are accepted


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("sensors.touch.normal_stiffness", "400.0", 400.0),
        ("sensors.touch.outputs", "[force]", ["force"]),
        ("sensors.touch.noise", "{like: noisy}", {"like": "noisy"}),
        ("sensors.touch.rate", "null", None),
    ],
)
def test_an_override_is_text_or_the_value_itself(key, text, value):
    plans = [tgdsl.compile(document(), overrides={key: given}).plan.to_json() for given in (text, value)]
    assert plans[0] == plans[1]


@pytest.mark.parametrize("name", ["float64", "torch.float64"])
def test_a_dtype_goes_by_its_name(name, tmp_path):
    assert tgdsl.compile(document(), dtype=name).dtype == torch.float64
    tgdsl.save(tgdsl.compile(document()), tmp_path / "x.safetensors")
    assert tgdsl.load(tmp_path / "x.safetensors", dtype=name).dtype == torch.float64


def readings(seed):
    touch = tgdsl.compile(document(), dtype=torch.float64).seed(seed)
    return touch, torch.stack([touch(touch.example_state(3, seed=i))["touch"] for i in range(4)])


def test_any_integer_is_a_seed():
    """Those that differ by a multiple of 2⁶⁴ are the same; all others, of those tried, are not."""
    seeds = [0, 2**63 - 1, 2**63, 2**64 - 1, -(2**63), -1, 10**30]
    drawn = {seed: readings(seed)[1] for seed in seeds}
    for first in seeds:
        for second in seeds:
            assert torch.equal(drawn[first], drawn[second]) == ((first - second) % 2**64 == 0), (first, second)
    assert torch.equal(readings(10**30 + 2**64)[1], drawn[10**30])


def test_a_folded_seed_goes_on_from_a_state_dict():
    touch, _ = readings(2**63 + 5)
    again = tgdsl.compile(document(), dtype=torch.float64)
    again.load_state_dict(touch.state_dict())
    state = touch.example_state(3, seed=9)
    torch.testing.assert_close(again(state)["touch"], touch(state)["touch"], rtol=0, atol=0)


@pytest.mark.parametrize("given", [[1], torch.tensor([1]), torch.tensor([False, True, False]), [False, True, False]])
def test_reset_of_some(given):
    """The others' episode goes on."""
    touch, _ = readings(0)
    touch.reset(given)
    assert touch.state_dict()["memory.clock.episode"].tolist() == [0, 1, 0]
    touch.reset([])
    assert touch.state_dict()["memory.clock.episode"].tolist() == [0, 1, 0]
    touch.reset()
    assert touch.state_dict()["memory.clock.episode"].tolist() == [1, 2, 1]


def test_nothing_has_changed_after_a_refusal():
    touch, _ = readings(0)
    before = {name: value.clone() for name, value in touch.state_dict().items()}
    for call in (lambda: touch.reset([0, 3]), lambda: touch.seed(0, first_env=-1)):
        with pytest.raises(TgdslError):
            call()
    torch.testing.assert_close(dict(touch.state_dict()), before, rtol=0, atol=0)


def test_masks_of_environments():
    """On one device; None is all."""
    cpu = torch.device("cpu")
    for given, expected in (
        (None, [1, 1, 1]),
        ([2, 0], [1, 0, 1]),
        (torch.tensor([1], dtype=torch.int32), [0, 1, 0]),
        ([], [0, 0, 0]),
    ):
        assert env_mask(given, 3, cpu).tolist() == [bool(value) for value in expected]
    for error in (SimulationError, StateError):
        with pytest.raises(error, match=r"^env_ids: found 3, expected indices from 0 to 2, or a mask of 3$"):
            env_mask([3], 3, cpu, error)


def test_indices_on_a_device_are_looked_at_only_by_who_waits():
    """On the device `meta` tensors have no numbers: whoever looked at one would fail."""
    meta = torch.device("meta")
    for dtype in (torch.int32, torch.int64):
        mask = env_mask(torch.tensor([5], dtype=dtype, device=meta), 3, meta, waits=False)
        assert (mask.shape, mask.dtype, mask.device) == ((3,), torch.bool, meta)
    with pytest.raises(NotImplementedError):  # a simulation does look, and waits for it
        env_mask(torch.tensor([5], device=meta), 3, meta)
    given = torch.ones(3, dtype=torch.bool, device=meta)
    assert env_mask(given, 3, meta) is given
    assert env_mask(None, 3, meta).device == meta


def test_a_file_error_is_the_systems_too(tmp_path):
    with pytest.raises(OSError, match=r"this is a folder") as caught:
        tgdsl.save(tgdsl.compile(document()), tmp_path)
    assert isinstance(caught.value, FileError)
    assert isinstance(caught.value, TgdslError)


def test_a_clock_without_noise_takes_a_seed():
    Clock([]).seed_with(2**100, None)
