"""Touch in Genesis by the documentation's code: readings match plain MuJoCo in the same pose, forces are Genesis's."""

import json
import re
from pathlib import Path

import genesis as gs
import mujoco
import numpy as np
from scene_of_adapters import CUBE, FREE, LOAD, PALM_AND_PAD, document

import tgdsl
from tgdsl.quantities.pairs import Pair


def test_the_documented_code_reads_touch(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "genesis.md").read_text(encoding="utf-8")
    lines = re.search(r"^```python\n(import torch\nimport tgdsl\n.*?)^```$", page, flags=re.M | re.S)[1]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hand.yaml").write_text(json.dumps(document(tmp_path, load=LOAD)), encoding="utf-8")
    gs.init(backend=gs.cpu, logging_level="error", precision="32")
    scene = gs.Scene(sim_options=gs.options.SimOptions(dt=0.002), show_viewer=False)
    for name, body in (("hand", PALM_AND_PAD), ("cube", CUBE)):
        (tmp_path / f"{name}.xml").write_text(f'<mujoco model="{name}"><worldbody>{body}</worldbody></mujoco>')
        scene.add_entity(gs.morphs.MJCF(file=str(tmp_path / f"{name}.xml")))
    scene.build(n_envs=2)
    solver = scene.rigid_solver
    speed = np.random.default_rng(0).normal(size=(2, solver.n_dofs), scale=0.05)
    solver.set_dofs_velocity(speed)
    for _ in range(20):
        scene.step()
    names = {"scene": scene}
    exec(lines, names)
    touch, readings = names["touch"], names["readings"]
    near = FREE.replace("<worldbody>", '<default><geom margin=".001"/></default><worldbody>')  # contacts like Genesis's
    model, datas = mujoco.MjModel.from_xml_string(near), []
    pos, quat = solver.get_links_pos(), solver.get_links_quat()
    vel, ang = solver.get_links_vel(), solver.get_links_ang()
    for env in range(2):
        data = mujoco.MjData(model)
        for i, link in enumerate(solver.links[1:], start=1):
            joint, inverse, spin = model.joint(int(model.body(link.name).jntadr[0])), np.zeros(4), np.zeros(3)
            turn, twist = quat[env, i].double().numpy(), ang[env, i].double().numpy()
            mujoco.mju_negQuat(inverse, turn)
            mujoco.mju_rotVecQuat(spin, twist, inverse)
            data.qpos[joint.qposadr[0] :][:7] = [*pos[env, i].tolist(), *turn]
            data.qvel[joint.dofadr[0] :][:6] = [*vel[env, i].tolist(), *spin]
        mujoco.mj_forward(model, data)
        datas.append(data)
    expected = touch(tgdsl.read_mujoco(touch, model, datas))["skin"]
    assert (readings["skin"][0] != readings["skin"][1]).any()
    for part in (slice(0, 3), slice(3, 6)):
        scale = float(expected[..., part].abs().max())
        assert float((readings["skin"][..., part] - expected[..., part]).abs().max()) <= 1e-6 * scale
    hand, palm = scene.entities[0], touch.inputs.pairs.index(Pair("palm", "cube"))
    genesis_force = hand.get_links_net_contact_force()[:, [link.name for link in hand.links].index("palm")]
    assert genesis_force.abs().max() > 0.5
    net = names["state"]().contact_netforce[:, palm]
    np.testing.assert_allclose(net, genesis_force, atol=1e-6 * float(genesis_force.abs().max()))
