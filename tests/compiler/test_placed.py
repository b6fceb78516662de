"""Taxels of a document at several resolutions."""

import numpy as np

from tgdsl.compiler import resolve
from tgdsl.compiler.pipeline import placed
from tgdsl.placement.sample import poisson

COUNTS = {"low": 10, "med": 40, "high": 160}


def test_resolutions_share_the_robot_and_the_sampled_points(tmp_path, monkeypatch):
    """The robot is compiled once and each link sampled once; taxels equal those of each resolution alone."""
    (tmp_path / "hand.xml").write_text(
        '<mujoco><worldbody><body name="a"><geom type="box" size=".02 .03 .01"/></body>'
        '<body name="b" pos=".1 0 0"><geom type="sphere" size=".02"/></body></worldbody></mujoco>'
    )
    links = {
        name: {link: {"method": "poisson", "count": count, "radius": 0.002} for link in "ab"} for name, count in COUNTS.items()
    }
    document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": {"resolutions": links}}}
    alone = {name: placed(document, resolutions=[name]).layouts[name] for name in COUNTS}
    loaded, sampled = [], []
    load_model, pool = resolve.load_model, poisson.pool
    monkeypatch.setattr(resolve, "load_model", lambda file: loaded.append(file) or load_model(file))
    monkeypatch.setattr(poisson, "pool", lambda *args: sampled.append(args) or pool(*args))
    together = placed(document).layouts
    assert len(loaded) == 1 and len(sampled) == 2
    for name, count in COUNTS.items():
        assert together[name].num_taxels == 2 * count
        np.testing.assert_array_equal(together[name].pos, alone[name].pos)
        np.testing.assert_array_equal(together[name].area, alone[name].area)
