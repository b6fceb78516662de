"""Setting states, on both simulators: against a fresh `MjData` with the same values, and with the other environments unchanged."""

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import MOVING_FORCE, SCENE, TOLERANCE, assert_agree, module, wanting_contacts, warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.simulators.state_values import INTEGRATED
from tgdsl.runtime.warp.stream import WarpStream

DERIVED = ("xpos", "xquat", "cvel", "subtree_com", "sensordata", "qacc", "geom_xpos")
BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])
PRESSED = {"kind": "contact", "threshold": 1e-3, "release_threshold": 5e-4}


def random_states(model, num: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return states in which the cube penetrates the table, turned about the vertical, and everything moves."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-3, 3, size=num)
    qpos = np.tile(model.qpos0, (num, 1))
    qpos[:, :3] += rng.uniform([-0.01, -0.01, -5e-4], [0.01, 0.01, 0], size=(num, 3))
    qpos[:, 3:7] = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    qpos[:, 7:] = rng.uniform(-0.5, 0.5, size=(num, 2))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qvel = rng.normal(size=(num, model.nv)) * [0.2, 0.2, 0.01, 0.1, 0.1, 1, 3, 3]
    return {"qpos": qpos, "qvel": qvel, "ctrl": rng.normal(size=(num, model.nu))}


def fresh_data(model, values: dict[str, np.ndarray], keyframe: int = -1) -> mujoco.MjData:
    data = mujoco.MjData(model)
    if keyframe >= 0:
        mujoco.mj_resetDataKeyframe(model, data, keyframe)
    for name, value in values.items():
        getattr(data, name)[...] = value
    mujoco.mj_forward(model, data)
    return data


def all_arrays(sim) -> dict[str, np.ndarray]:
    if isinstance(sim, BatchSimulation):
        return {name: np.array(getattr(sim.batch, name)) for name in (*INTEGRATED, *DERIVED)}
    sim.state()
    # Counts of rows and contacts belong to the last evaluation, of whichever environments.
    return {n: a.numpy().copy() for n, a in sim.arrays.items() if len(a) == sim.num_envs and n != "nefc"}


def equivalent_arguments(simulator, values, ids, num_envs):
    """Return the same choice and values by indices, by reversed indices, and by a mask, as arrays and as tensors."""
    rows = {name: np.full((num_envs, value.shape[1]), np.nan) for name, value in values.items()}
    for name, value in values.items():
        rows[name][ids] = value
    mask = np.isin(np.arange(num_envs), ids)
    flipped = {name: torch.from_numpy(value).flip(0) for name, value in values.items()}
    return [
        (ids, values),
        (ids[::-1], flipped),
        (mask, rows),
        (torch.from_numpy(mask), {name: torch.from_numpy(value).requires_grad_() for name, value in rows.items()}),
    ]


# MuJoCo on the CPU: exactly


@pytest.mark.parametrize("form", range(4))
def test_reset_with_values_matches_a_fresh_mjdata_then_and_in_later_steps(tmp_path, form):
    touch, model = wanting_contacts(tmp_path)
    sim = BatchSimulation(touch, 5, model=model, keyframe="home")
    for name in DERIVED:
        sim.batch.bind(name)
    for _ in range(7):
        sim.step(np.array([0.2, -0.3]))
    before, ids = all_arrays(sim), [1, 3]
    values = random_states(model, 2)
    chosen, arguments = equivalent_arguments(BatchSimulation, values, ids, 5)[form]
    sim.reset(chosen, **arguments)
    after, singles = all_arrays(sim), [fresh_data(model, {n: v[i] for n, v in values.items()}, 0) for i in range(2)]
    for name, array in after.items():
        np.testing.assert_array_equal(array[[0, 2, 4]], before[name][[0, 2, 4]], err_msg=name)
        for env, data in zip(ids, singles, strict=True):
            np.testing.assert_array_equal(array[env], getattr(data, name), err_msg=name)
    assert all(data.ncon == 4 for data in singles) and np.abs(after["qacc"][ids]).max() > 1
    state, cube = sim.state(), touch.inputs.bodies.index("cube")
    np.testing.assert_array_equal(state.body_pos[ids, cube].numpy(), [data.body("cube").xpos for data in singles])
    pair = [(pair.link, pair.object) for pair in touch.inputs.pairs].index(("table", "cube"))
    assert (state.contact_found[ids, pair] == 4).all() and (state.contact_netforce[ids, pair, 2] < -0.1).all()
    for step in range(20):
        sim.step(np.full(2, 0.1 * step))
        for env, data in zip(ids, singles, strict=True):
            data.ctrl[:] = 0.1 * step
            mujoco.mj_step(model, data)
            for name in ("qpos", "qvel", "qacc_warmstart", "time", "sensordata"):
                np.testing.assert_array_equal(getattr(sim.batch, name)[env], getattr(data, name), err_msg=name)


def test_set_state_equals_assignment_and_mj_forward(tmp_path):
    """Time, warm start and arrays that are not passed stay as in an `MjData` that is stepped, assigned to and evaluated."""
    touch, model = wanting_contacts(tmp_path)
    sim, data = BatchSimulation(touch, 3, model=model, keyframe="home"), fresh_data(model, {}, 0)
    for name in DERIVED:
        sim.batch.bind(name)
    for _ in range(5):
        sim.step()
        mujoco.mj_step(model, data)
    before, values = all_arrays(sim), {name: value[0] for name, value in random_states(model, 1).items()}
    sim.set_state([1], qpos=values["qpos"], qvel=values["qvel"])
    data.qpos[:], data.qvel[:] = values["qpos"], values["qvel"]
    mujoco.mj_forward(model, data)
    assert np.abs(data.qacc_warmstart).max() > 1 and data.time > 0
    for _ in range(10):
        for name, array in all_arrays(sim).items():
            np.testing.assert_array_equal(array[1], getattr(data, name), err_msg=name)
            if _ == 0:
                np.testing.assert_array_equal(array[[0, 2]], before[name][[0, 2]], err_msg=name)
        sim.step()
        mujoco.mj_step(model, data)


def test_the_integrated_state_copies_an_environment(tmp_path):
    touch, model = wanting_contacts(tmp_path)
    sim = BatchSimulation(touch, 2, model=model, keyframe="home")
    for i in range(10):
        sim.step(np.array([[0.1 * i, 0], [0, 0.3]]))
    sim.set_state([1], **{name: np.array(getattr(sim.batch, name)[0]) for name in INTEGRATED})
    for _ in range(5):
        sim.step()
        np.testing.assert_array_equal(sim.batch.state[1], sim.batch.state[0])


@BOTH
def test_quaternions_are_normalised_by_mujocos_rule(tmp_path, simulator):
    touch = module(tmp_path)
    sim, long = simulator(touch, 3, keyframe="home"), np.array([0.6, -1.2, 0.3, 2.0])
    qpos = np.tile(sim.model.qpos0, (3, 1))
    qpos[:, 3:7] = long * np.array([[1.0], [1e-3], [1 / np.linalg.norm(long)]])
    sim.reset(qpos=qpos)
    expected = qpos[1].copy()
    mujoco.mj_normalizeQuat(sim.model, expected)
    eps = float(torch.finfo(sim.qpos.dtype).eps)
    np.testing.assert_allclose(sim.qpos[:, 3:7], [expected[3:7]] * 3, rtol=0, atol=2 * eps)
    np.testing.assert_allclose(sim.state().body_quat[:, touch.inputs.bodies.index("cube")], sim.qpos[:, 3:7], atol=4 * eps)
    sim.set_state(qpos=sim.qpos)
    unit = sim.qpos.clone()
    sim.set_state(qpos=unit)  # unit quaternions stay bit-identical
    assert torch.equal(sim.qpos, unit)


@BOTH
def test_quaternions_of_mocap_bodies_and_ball_joints_are_normalised(tmp_path, simulator):
    """Quaternions of length zero are refused."""
    bodies = (
        '<body name="led" mocap="true" pos="1 0 0"><geom size=".01"/></body>'
        '<body name="ball" pos="-1 0 0"><joint type="ball"/><geom size=".01"/></body></worldbody>'
    )
    text = SCENE[: SCENE.index("<keyframe>")] + "</mujoco>"
    sim = simulator(module(tmp_path, text.replace("</worldbody>", bodies)), 2)
    quaternion = np.array([0.0, 3.0, 0.0, -4.0])
    qpos = sim.model.qpos0.copy()
    qpos[sim.joints["ball"].qpos] = quaternion
    sim.set_state([1], mocap_pos=[[0, 2, 0]], mocap_quat=quaternion[None], qpos=qpos)
    pos, quat = sim.body_poses(1)
    np.testing.assert_allclose(pos[sim.model.body("led").id], [0, 2, 0], atol=1e-7)
    for name in ("led", "ball"):
        np.testing.assert_allclose(quat[sim.model.body(name).id], quaternion / 5, atol=1e-7)
    np.testing.assert_allclose(sim.qpos[1, sim.joints["ball"].qpos], quaternion / 5, atol=1e-7)
    np.testing.assert_allclose(sim.body_poses(0)[0][sim.model.body("led").id], [1, 0, 0])
    qpos[sim.joints["ball"].qpos] = 0
    for name, zero in (("mocap_quat", np.zeros((1, 4))), ("qpos", qpos)):
        with pytest.raises(SimulationError, match=rf"^{name} holds a quaternion of length 0 in environments 0, 1$"):
            sim.set_state(**{name: zero})


# both


@pytest.mark.parametrize("form", range(4))
def test_warp_sets_the_chosen_environments_and_leaves_the_others(tmp_path, form):
    touch, model = wanting_contacts(tmp_path)
    sim, twin = (warp(touch, 5, model=model, keyframe="home") for _ in range(2))
    cpu = BatchSimulation(touch, 5, model=model, keyframe="home")
    for each in (sim, twin, cpu):
        each.warp_model.opt.tolerance.fill_(model.opt.tolerance) if each is not cpu else None
        for _ in range(4):
            each.step(np.array([0.2, -0.3]))
        each.ctrl[...] = 0.7  # set now: the forces still come from the last step
    before, ids = all_arrays(sim), [1, 3]
    values = {name: value.astype(np.float32).astype(np.float64) for name, value in random_states(model, 2).items()}
    chosen, arguments = equivalent_arguments(warp, values, ids, 5)[form]
    sim.reset(chosen, **arguments)
    cpu.reset(ids, **values)
    after = all_arrays(sim)
    assert {"geom_xpos", "qfrc_actuator", "qacc_warmstart", "time", "cvel", "sensordata"} <= set(after)
    for name, array in after.items():
        np.testing.assert_array_equal(array[[0, 2, 4]], before[name][[0, 2, 4]], err_msg=name)
    state, expected_state = sim.state(), cpu.state()
    rows = {name: (getattr(state, name)[ids], getattr(expected_state, name)[ids]) for name in touch.inputs.fields}
    assert_agree(*(tgdsl.SceneState(**{name: pair[i] for name, pair in rows.items()}) for i in range(2)), touch.inputs.fields)
    assert (sim.arrays["time"][ids] == 0).all() and (sim.arrays["qacc_warmstart"][ids] == 0).all()
    for _ in range(5):
        for each in (sim, twin, cpu):
            each.step(np.array([0.1, 0.1]))
    for name in ("qpos", "qvel", "xpos", "time"):
        assert torch.equal(sim.arrays[name][[0, 2, 4]], twin.arrays[name][[0, 2, 4]]), name
    np.testing.assert_allclose(sim.qpos[ids], cpu.qpos[ids], atol=TOLERANCE)
    np.testing.assert_allclose(sim.qvel[ids], cpu.qvel[ids], atol=MOVING_FORCE)


@BOTH
def test_reset_starts_an_episode_and_set_state_does_not(tmp_path, simulator):
    text = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .028"')
    touch = module(tmp_path, text, links=("table",), **PRESSED)
    sim = simulator(touch, 3)
    sim.step()
    assert touch(sim.state())["touch"].all()
    bits, high = touch.memory.get_buffer("touch:bit"), sim.model.qpos0 + np.eye(sim.model.nq)[2]
    time = (sim.batch.time if isinstance(sim, BatchSimulation) else sim.arrays["time"])[...]
    sim.set_state([1], qpos=high)
    assert bits.all() and (np.asarray(time) > 0).all()
    assert touch(sim.state())["touch"].flatten(1).any(dim=1).tolist() == [True, False, True]
    sim.reset([0], qpos=high)
    assert bits.flatten(1).any(dim=1).tolist() == [False, False, True]
    np.testing.assert_allclose(np.asarray(time), [0, 0.002, 0.002])
    assert touch(sim.state())["touch"].flatten(1).any(dim=1).tolist() == [False, False, True]


@BOTH
def test_forward_evaluates_values_written_into_live_tensors(tmp_path, simulator):
    touch = module(tmp_path)
    sim = simulator(touch, 3, keyframe="home")
    assert (sim.qpos.shape, sim.qvel.shape, sim.ctrl.shape) == ((3, 9), (3, 8), (3, 2))
    assert sim.qpos.dtype == (torch.float64 if isinstance(sim, BatchSimulation) else torch.float32)
    sim.step()
    cube, before = touch.inputs.bodies.index("cube"), sim.state().body_pos
    assert (before[:, cube] - sim.qpos[:, :3]).abs().amax() > 1e-5  # a step behind
    sim.forward([0, 2])
    after = sim.state().body_pos
    assert torch.equal(after[1], before[1])
    torch.testing.assert_close(after[[0, 2], cube], sim.qpos[[0, 2], :3].to(after.dtype), atol=1e-7, rtol=0)
    sim.qpos[1, 2], sim.qvel[1] = 0.5, 0.0
    assert torch.equal(sim.state().body_pos, after)
    sim.forward()
    assert sim.state().body_pos[1, cube, 2] == 0.5
    sim.step()
    assert 0.49 < float(sim.qpos[1, 2]) < 0.5  # and it falls from there


@BOTH
def test_joints_by_name(tmp_path, simulator):
    sim = simulator(module(tmp_path), 2)
    assert sim.joint_names == ("cube", "one", "two")  # the free joint takes the name of its body
    assert [(joint.qpos, joint.qvel) for joint in sim.joints.values()] == [
        (slice(0, 7), slice(0, 6)),
        (slice(7, 8), slice(6, 7)),
        (slice(8, 9), slice(7, 8)),
    ]
    data = mujoco.MjData(sim.model)
    data.qpos[:] = np.arange(9)
    np.testing.assert_array_equal(data.qpos[sim.joints["two"].qpos], data.joint("two").qpos)
    with pytest.raises(SimulationError, match=r'^the scene has no joint "tow"; did you mean "two"\?$'):
        sim.joints["tow"]


def test_joints_that_share_a_body_need_names():
    text = "<body name='a'>{}<geom size='.1'/></body>"
    joints = "<joint type='ball'/><joint type='slide'/>"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{text.format(joints)}<body name='b'><joint name='a'/><geom size='.1'/></body>"
        "<body name='c'><joint type='ball'/><geom size='.1'/></body></worldbody></mujoco>"
    )
    from tgdsl.runtime.simulators.model_ids import Joint, Joints

    assert Joints(model) == {"a": Joint(slice(5, 6), slice(4, 5)), "c": Joint(slice(6, 10), slice(5, 8))}


WRONG = [
    (
        {"qpos": np.zeros((2, 9))},
        None,
        r"^qpos has shape \(2, 9\), expected \(3, 9\), a row per environment, or \(9,\) for all$",
    ),
    ({"qvel": np.zeros((3, 8))}, [0], r"^qvel has shape \(3, 8\), expected \(1, 8\), a row for each index, or \(8,\) for all$"),
    ({"ctrl": 1.0}, None, r"^ctrl has shape \(\), expected \(3, 2\), a row per environment, or \(2,\) for all$"),
    ({"qpo": np.zeros(9)}, None, r'^the state has no array "qpo"; did you mean "qpos"\?$'),
    ({"qvel": ["fast"] * 8}, None, r"^qvel is no array of numbers: "),
    ({"qvel": np.zeros((2, 8))}, [2, 2], r"^env_ids: environments 2 are named more than once, and qvel has a row for each$"),
    ({"qvel": np.full(8, np.nan)}, [2, 0], r"^qvel is not finite in environments 0, 2$"),
    ({"qvel": np.full((2, 8), [[0], [np.inf]])}, [2, 0], r"^qvel is not finite in environments 0$"),
    ({"qpos": np.zeros(9)}, [1], r"^qpos holds a quaternion of length 0 in environments 1$"),
    ({"qpos": np.ones(9)}, [3], r"^env_ids: found 3, expected indices from 0 to 2, or a mask of 3$"),
]


@BOTH
def test_invalid_values_are_refused_and_change_nothing(tmp_path, simulator):
    sim = simulator(module(tmp_path), 3, keyframe="home")
    sim.step()
    before = all_arrays(sim)
    for values, ids, message in WRONG:
        for call in (sim.reset, sim.set_state):
            with pytest.raises(SimulationError, match=message):
                call(ids, **{"ctrl": np.ones(2), **values})
    after = all_arrays(sim)
    assert all(np.array_equal(after[name], before[name]) for name in before)
    is_chosen = torch.tensor([True, False, True])
    sim.set_state(is_chosen, qvel=torch.full((3, 8), torch.nan).index_fill(0, torch.tensor([0, 2]), 0.25))  # row 1 is ignored
    torch.testing.assert_close(sim.qvel[is_chosen], torch.full((2, 8), 0.25, dtype=sim.qvel.dtype))
    sim.set_state([], qpos=np.zeros((0, 9)))


@BOTH
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int32])
def test_values_may_have_any_dtype(tmp_path, simulator, dtype):
    sim = simulator(module(tmp_path), 2)
    sim.set_state([1], qvel=torch.arange(8, dtype=dtype), time=torch.tensor([3.0]), ctrl=[1, 2])
    assert sim.qvel[1].tolist() == list(range(8)) and sim.qvel[0].tolist() == [0.0] * 8
    assert sim.ctrl.tolist() == [[0, 0], [1, 2]]


def test_float64_values_beyond_float32_are_refused(tmp_path):
    sim = warp(module(tmp_path), 2)
    with pytest.raises(SimulationError, match=r"^qvel is not finite in environments 0, 1$"):
        sim.set_state(qvel=np.full(8, 1e300))
    with pytest.raises(SimulationError, match=r"^control is not finite in environments 1$"):
        sim.step(np.array([[0, 0], [1e300, 0]]))


@BOTH
def test_set_state_and_reset_work_under_inference_mode(tmp_path, simulator):
    touch = module(tmp_path)
    with torch.inference_mode():
        sim = simulator(touch, 2, keyframe="home")
        sim.step()
        sim.reset([1], qvel=torch.ones(8))
    sim.set_state([0], qvel=torch.ones(8))
    sim.step()
    assert torch.isfinite(sim.qpos).all()


def test_reset_in_a_users_graph_is_evaluated_at_once(tmp_path, monkeypatch):
    """A captured reset is replayed without the host, so evaluation cannot be deferred to a later reading.

    After such a capture, every reset is evaluated at once.
    """
    sim, twin = (warp(module(tmp_path), 3, keyframe="home") for _ in range(2))
    for each in (sim, twin):
        each.step()
    mask, qpos = torch.tensor([True, False, True]), sim.qpos + torch.eye(9)[2]
    assert not sim._stream.is_capturing
    monkeypatch.setattr(WarpStream, "is_capturing", property(lambda self: True))
    monkeypatch.setattr(WarpStream, "capture_scope", WarpStream.scope)
    sim.reset(mask, qpos=qpos)
    arrays = {name: sim.arrays[name].clone() for name in ("xpos", "cvel", "geom_xpos")}
    monkeypatch.undo()
    twin.reset(mask, qpos=qpos)
    assert not torch.equal(twin.arrays["xpos"], arrays["xpos"])  # the twin waits for `state`
    twin.state()
    for name, value in arrays.items():
        assert torch.equal(twin.arrays[name], value), name
    for each in (sim, twin):
        each.reset(mask)
    assert not torch.equal(twin.arrays["xpos"], sim.arrays["xpos"])
    assert torch.equal(twin.state().body_pos, sim.state().body_pos) and torch.equal(twin.arrays["xpos"], sim.arrays["xpos"])


@BOTH
def test_a_state_carries_its_time(tmp_path, simulator):
    """`time` is MuJoCo's clock at the instant of the poses: one physics step behind after a step, else now."""
    touch = module(tmp_path)
    sim = simulator(touch, 3, substeps=4, keyframe="home")
    data = fresh_data(sim.model, {}, keyframe=0)
    assert sim.state().time.tolist() == [0.0] * 3 == sim.time.tolist()
    sim.step(), sim.step()
    for _ in range(7):
        mujoco.mj_step(sim.model, data)
    instant = data.time
    mujoco.mj_step(sim.model, data)
    cube = touch.inputs.bodies.index("cube")
    state = sim.state()
    torch.testing.assert_close(state.time.double(), torch.full((3,), instant, dtype=torch.float64), rtol=0, atol=1e-8)
    pos = torch.from_numpy(data.body("cube").xpos.copy()).expand(3, 3)
    torch.testing.assert_close(state.body_pos[:, cube].double(), pos, rtol=0, atol=1e-6)
    sim.forward([1]), sim.reset([2])
    expected = torch.tensor([instant, data.time, 0.0], dtype=torch.float64)
    for time in (sim.time, sim.state().time):
        torch.testing.assert_close(time.double(), expected, rtol=0, atol=1e-8)
    assert [round(float(substate.time[0]), 4) for substate in sim.substates()] == [0.016, 0.018, 0.02, 0.022]
    torch.testing.assert_close(state.time.double(), torch.full((3,), instant, dtype=torch.float64), rtol=0, atol=1e-8)
