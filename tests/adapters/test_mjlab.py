"""Touch in the installed mjlab: readings match plain MuJoCo in the same state."""

import json
import re
from pathlib import Path

import mujoco
import mujoco_warp
import numpy as np
import pytest
import scene_of_adapters
import torch
import warp as wp
from capture_recorder import Recorder
from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg

import tgdsl
from tgdsl.adapters.mjlab import TouchSensorCfg, observation, reading
from tgdsl.errors import SimulationError, TgdslError
from tgdsl.module.calls import Graphed

HAND = """
<body name="palm">
  <geom type="box" size=".05 .05 .01" friction="1"/>
  <body name="pad" pos="0 0 .08">
    <joint name="bend" axis="0 1 0" damping=".01"/>
    <geom type="box" size=".03 .02 .015" pos="0 0 .02" mass=".1"/>
  </body>
</body>
"""
CUBE = '<body name="cube" pos="0 0 .0298"><freejoint/><geom type="box" size=".02 .02 .02" mass=".25" friction="1"/></body>'
DECIMATION = 3


def mjcf(*bodies: str) -> str:
    return f'<mujoco><option timestep=".002"/><worldbody>{"".join(bodies)}</worldbody></mujoco>'


def document(folder, **sensors) -> dict:
    return scene_of_adapters.document(folder, mjcf(HAND, CUBE), **sensors)


def touch_reward(env) -> torch.Tensor:
    return env.scene["touch"].data["skin"].abs().sum(dim=(1, 2))


def entities() -> dict[str, EntityCfg]:
    spec = mujoco.MjSpec.from_string
    free = EntityCfg.InitialStateCfg(pos=(0, 0, 0.0298), joint_pos={}, joint_vel={})
    return {
        "robot": EntityCfg(spec_fn=lambda: spec(mjcf(HAND))),
        "object": EntityCfg(spec_fn=lambda: spec(mjcf(CUBE)), init_state=free),
    }


def make(sensor, terms, rewards=None) -> ManagerBasedRlEnv:
    groups = {"actor": ObservationGroupCfg(terms={name: ObservationTermCfg(**term) for name, term in terms.items()})}
    return make_env(SceneCfg(num_envs=2, entities=entities(), sensors=(sensor,)), groups, rewards)


def make_env(scene, observations, rewards=None, device="cpu") -> ManagerBasedRlEnv:
    cfg = ManagerBasedRlEnvCfg(
        decimation=DECIMATION,
        episode_length_s=10.0,
        scene=scene,
        observations=observations,
        rewards=rewards or {},
        sim=SimulationCfg(nconmax=16, njmax=64, mujoco=MujocoCfg(timestep=0.002)),
    )
    return ManagerBasedRlEnv(cfg, device=device)


TERMS = {
    "skin": {"func": reading, "params": {"sensor": "touch", "name": "skin"}},
    "policy": {"func": observation, "params": {"sensor": "touch"}},
}


def push(env) -> None:
    """Move joints and cube differently in each environment."""
    rng = np.random.default_rng(0)
    env.sim.data.qvel[:] = torch.from_numpy(rng.normal(size=env.sim.data.qvel.shape, scale=0.05)).to(env.sim.data.qvel)
    env.sim.data.qvel[:, env.sim.mj_model.joint("robot/bend").dofadr[0]] = 3.0


def steps(env, num) -> torch.Tensor:
    action = torch.zeros(env.num_envs, env.action_manager.total_action_dim, device=env.device)
    for _ in range(num):
        obs = env.step(action)[0]
    return obs["actor"]


THERE = {"palm": "robot/palm", "pad": "robot/pad", "cube": "object/cube"}


def plain(env, touch) -> tgdsl.SceneState:
    """Return plain MuJoCo's state at the positions of mjlab's environments."""
    inputs = touch.inputs.renamed(THERE)
    model = tgdsl.instrument(env.scene.spec.copy(), inputs).compile()
    datas = []
    for i in range(env.num_envs):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = env.sim.data.qpos[i].numpy(), env.sim.data.qvel[i].numpy()
        mujoco.mj_forward(model, data)
        datas.append(data)
    return tgdsl.read_mujoco(touch, model, datas, inputs=inputs)


def test_readings_match_plain_mujoco(tmp_path):
    doc = document(tmp_path)
    env = make(TouchSensorCfg(name="touch", document=doc), TERMS)
    env.reset()
    push(env)
    obs = steps(env, 4)
    touch = tgdsl.compile(doc)
    skin, expected = env.scene["touch"].data["skin"], touch(plain(env, touch))["skin"]
    assert (skin[0] != skin[1]).any()
    assert (expected[..., :3].abs() > 1e-3).any()
    for part in (slice(0, 3), slice(3, 6)):  # forces and torques, each relative to its full scale
        scale = float(expected[..., part].abs().max())
        assert float((skin[..., part] - expected[..., part]).abs().max()) <= 1e-6 * scale
    assert torch.equal(obs[:, : skin[0].numel()], skin.flatten(1))
    assert torch.equal(obs[:, skin[0].numel() :], touch.observe({"skin": skin})["policy"])
    env.close()


def test_loads_are_mjlabs_contact_forces(tmp_path):
    load = {"kind": "link_contact", "links": ["palm"], "feels": ["cube"], "outputs": ["force"]}
    env = make(TouchSensorCfg(name="touch", document=document(tmp_path, load=load)), TERMS)
    env.reset()
    steps(env, 4)
    model, data = env.sim.mj_model, env.sim.wp_data
    count = int(data.nacon.numpy()[0])
    wrenches = wp.zeros(count, dtype=wp.spatial_vector)
    mujoco_warp.contact_force(env.sim.wp_model, data, wp.array(np.arange(count), dtype=int), True, wrenches)
    net = np.zeros((2, 3))
    for world, geoms, wrench in zip(data.contact.worldid.numpy(), data.contact.geom.numpy(), wrenches.numpy(), strict=False):
        bodies = [model.body(model.geom_bodyid[geom]).name for geom in geoms]
        assert set(bodies) == {"robot/palm", "object/cube"}
        net[world] += wrench[:3] if bodies[1] == "robot/palm" else -wrench[:3]
    assert abs(net).max() > 1.0
    load_read = env.scene["touch"].data["load"].double().sum(dim=1).numpy()  # the palm has the axes of the world
    np.testing.assert_allclose(load_read, net, atol=1e-6 * abs(net).max())
    env.close()


def test_a_reading_advances_once_per_control_step(tmp_path):
    doc = document(tmp_path)
    reward = {"touch": RewardTermCfg(func=touch_reward, weight=1.0)}
    env = make(TouchSensorCfg(name="touch", document=doc), TERMS, reward)
    env.reset()
    sensor = env.scene["touch"]
    calls = []
    read = sensor.touch.forward
    sensor.touch.forward = lambda *args, **kwargs: calls.append(kwargs["mask"]) or read(*args, **kwargs)
    steps(env, 2)
    assert calls == [None, None]
    _ = sensor.data, sensor.data
    assert len(calls) == 2
    env.reset(env_ids=torch.tensor([1]))
    _ = sensor.data
    assert len(calls) == 3 and calls[2].tolist() == [False, True]
    env.close()


def readings_over_resets(doc, device, graph, capture=None) -> list[torch.Tensor]:
    """Return observations and readings of steps, with resets of one environment before and after its reading."""
    sensors = (TouchSensorCfg(name="touch", document=doc, graph=graph),)
    groups = {"actor": ObservationGroupCfg(terms={name: ObservationTermCfg(**term) for name, term in TERMS.items()})}
    env = make_env(SceneCfg(num_envs=2, entities=entities(), sensors=sensors), groups, device=device)
    sensor, result = env.scene["touch"], []
    if capture is not None:  # as on a GPU
        sensor._is_graphed, sensor._graphed = True, Graphed(lambda *_: sensor._read(), capture)
    env.reset()
    push(env)
    for i in range(8):
        result.append(steps(env, 1).clone())
        if i in (3, 5):
            env.reset(env_ids=torch.tensor([1], device=device))
            result.append(sensor.data["depth"].clone())
        if i == 6:
            sensor.update(0.002)  # the next reading is a physics step later than others
    result += [sensor.observations["policy"].clone(), observation(env, "touch").clone()]
    env.close()
    return result


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_replays_equal_calls(tmp_path, device):
    """With noise, delay and history; a graph holds the time between readings, and is captured again when that changes."""
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("there is no GPU")
    noise = {"bias": 1e-3, "white_noise": 1e-3, "drift": 1e-4, "read_delay": "6 ms"}
    noisy = {"kind": "contact_depth", "links": ["palm"], "feels": ["cube"], "history": 3, "noise": noise}
    doc, recorder = document(tmp_path, depth=noisy), Recorder()
    calls = readings_over_resets(doc, device, graph=False)
    replays = readings_over_resets(doc, device, graph=True, capture=recorder if device == "cpu" else None)
    assert recorder.count == (2 if device == "cpu" else 0)
    close = {"atol": 0.0, "rtol": 0.0} if device == "cpu" else {"atol": 1e-6, "rtol": 1e-5}  # compiled on a GPU
    for call, replay in zip(calls, replays, strict=True):
        torch.testing.assert_close(replay, call, **close)
    assert not torch.equal(calls[0], calls[7])


def test_resetting_one_environment_keeps_the_others(tmp_path):
    stacked = {"kind": "contact_depth", "links": ["palm"], "feels": ["cube"], "history": 3}
    env = make(TouchSensorCfg(name="touch", document=document(tmp_path, depth=stacked)), TERMS)
    env.reset()
    push(env)
    steps(env, 4)
    previous = env.scene["touch"].data["depth"].clone()
    assert not torch.equal(previous[1, 0], previous[1, -1])
    env.reset(env_ids=torch.tensor([1]))
    current = env.scene["touch"].data["depth"]
    assert torch.equal(current[0], previous[0])
    assert torch.equal(current[1], current[1, -1:].expand_as(current[1]))  # all stacked calls are of the new episode
    env.close()


def test_unknown_names_are_refused_when_the_environment_is_created(tmp_path):
    doc = document(tmp_path)
    for settings, message in (
        ({"names": {"pad": "robot/pda"}}, 'the scene has no body "robot/pda"; did you mean "robot/pad"?'),
        ({"prefix": "hand/"}, 'the scene has no body "hand/'),
    ):
        with pytest.raises(SimulationError, match=re.escape(message)):
            make(TouchSensorCfg(name="touch", document=doc, **settings), TERMS)
    wrong = {"skin": {"func": reading, "params": {"sensor": "touch", "name": "skn"}}}
    with pytest.raises(TgdslError, match=re.escape('the sensor "touch" has no reading "skn"; did you mean "skin"?')):
        make(TouchSensorCfg(name="touch", document=doc), wrong)


def test_the_documented_code_adds_touch_to_an_environment(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "mjlab.md").read_text(encoding="utf-8")
    lines = re.search(r"^```python\n(from mjlab.*?)^```$", page, flags=re.M | re.S)[1].replace("4096", "2")
    tips = {"kind": "contact_depth", "links": ["pad"], "feels": ["cube"]}
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hand.yaml").write_text(json.dumps(document(tmp_path, tips=tips)), encoding="utf-8")
    names = {"entities": entities()}
    exec(lines, names)
    env = make_env(names["scene"], names["observations"])
    env.reset()
    assert steps(env, 1).shape == (2, 8 * 3 + 4)  # forces of eight taxels, and depths of the pad's four
    env.close()


def test_taxels_are_drawn_at_their_positions(tmp_path):
    env = make(TouchSensorCfg(name="touch", document=document(tmp_path)), TERMS)
    env.reset()
    steps(env, 1)
    drawn = []

    class Spheres:
        def get_env_indices(self, num_envs):
            return [num_envs - 1]

        def add_sphere(self, center, radius, color):
            drawn.append(center)

    env.update_visualizers(Spheres())
    data = mujoco.MjData(env.sim.mj_model)
    data.qpos[:] = env.sim.data.qpos[1].numpy()
    mujoco.mj_kinematics(env.sim.mj_model, data)
    table = env.scene["touch"].touch.taxels["skin"]
    for row, center in zip(table, drawn, strict=True):
        body = env.sim.mj_model.body(THERE[str(row["body"])]).id
        np.testing.assert_allclose(center, data.xpos[body] + data.xmat[body].reshape(3, 3) @ row["pos"], atol=1e-6)
    env.close()
