"""Touch on gymnasium-robotics' Shadow hand by the documentation's code: loads are MuJoCo's contact forces."""

import re
from pathlib import Path

import mujoco
import numpy as np

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "adapters.md"


def test_the_documented_code_reads_touch(tmp_path, monkeypatch):
    section = PAGE.read_text(encoding="utf-8").split("## gymnasium-robotics")[1]
    document, lines = (re.search(rf"```{language}\n(.*?)```", section, flags=re.S)[1] for language in ("yaml", "python"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shadow.yaml").write_text(document, encoding="utf-8")
    names = {}
    exec(lines, names)
    touch, readings = names["touch"], names["readings"]
    model, data = names["env"].model, names["env"].data
    (links,) = (output.bodies for output in touch.outputs if output.name == "tips")
    net = {link: np.zeros(3) for link in links}
    assert len(net) == 5 and readings["skin"].shape[1] == 100
    for i in range(data.ncon):
        wrench, contact = np.zeros(6), data.contact[i]
        mujoco.mj_contactForce(model, data, i, wrench)
        bodies = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
        force = contact.frame.reshape(3, 3).T @ wrench[:3]
        for body, other, sign in ((bodies[1], bodies[0], 1.0), (bodies[0], bodies[1], -1.0)):
            if body in net and other == "object":
                net[body] += sign * data.body(body).xmat.reshape(3, 3).T @ force  # in the link's frame
    expected = np.stack([*net.values()])
    assert abs(expected).max() > 0.01
    np.testing.assert_allclose(readings["tips"][0], expected, atol=1e-6 * abs(expected).max())
