"""Temperature documents of the docs and the examples: they compile, and a palm warms."""

from pathlib import Path

import pytest
from oracles.setups.boxes import heat_module

import tgdsl

ROOT = Path(__file__).parents[3]
BLOCKS = [part.split("```")[0] for part in (ROOT / "docs" / "background" / "heat.md").read_text().split("```yaml\n")[1:]]


@pytest.mark.parametrize("text", BLOCKS)
def test_documents_in_the_docs_compile(text, tmp_path):
    path = tmp_path / "heat.yaml"
    path.write_text(text.replace("palm_cube.xml", str(ROOT / "examples" / "palm_cube.xml")))
    touch = tgdsl.compile(path)
    assert [output.name for output in touch.outputs] == ["heat", "heat/heat", "heat/objects"]


def test_a_warm_cube_warms_the_palm():
    """The links gain what the cube loses; 0.25 kg of it rests on the palm."""
    touch = tgdsl.compile(ROOT / "examples" / "warm_palm.yaml")
    sim = tgdsl.simulate(touch, 1, substeps=5, keyframe="rest")
    first = touch(sim.state())["heat/objects"]
    for _ in range(20):
        sim.step(sim.model.key("rest").ctrl)
        readings = touch(sim.state())
    lost = (first - readings["heat/objects"])[0, 0, 1]
    assert lost > 1.0
    assert readings["heat/heat"][0, :, 0].sum() == pytest.approx(float(lost), rel=1e-3)
    assert 22.0 <= readings["heat"].min() < readings["heat"].max() < 45.0


@pytest.mark.parametrize("sensor", [{"spacing": "0.02 mm"}, {"cells": [1500, 1000, 500]}])
def test_too_many_cells_are_a_mistake(sensor, tmp_path):
    """7.5e8 cells, in a box of 30 × 20 × 10 mm."""
    (field,) = sensor
    message = rf"sensors\.heat\.{field}: its links have 7\.5e\+08 cells, expected at most 1,000,000"
    with pytest.raises(tgdsl.SpecError, match=message):
        heat_module(tmp_path, {"a": [0.03, 0.02, 0.01]}, {"material": "copper", **sensor})


def test_a_link_that_is_a_plane_is_a_mistake(tmp_path):
    (tmp_path / "floor.xml").write_text(
        '<mujoco><worldbody><body name="floor"><geom type="plane" size="1 1 .1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "heat.yaml").write_text(
        "tgdsl: 1\nrobot: {model: floor.xml}\nsensors:\n  heat: {kind: temperature_grid, links: floor, cells: [1, 1, 1], material: steel}\n"
    )
    with pytest.raises(tgdsl.SpecError, match=r"heat\.yaml:4:.*sensors\.heat\.links: .*plane.*has no bounded surface"):
        tgdsl.compile(tmp_path / "heat.yaml")


def test_an_object_that_encloses_nothing_is_a_mistake(tmp_path):
    """An open mesh with inconsistent faces has only rounding errors as its volume: it held 4e-16 J."""
    (tmp_path / "shell.xml").write_text(
        '<mujoco><asset><mesh name="shell" inertia="shell" vertex="0 0 0 .02 0 0 0 .02 0 0 0 .02" face="0 1 2 0 1 3"/></asset>'
        '<worldbody><body name="tip"><freejoint/><geom type="box" size=".01 .01 .01"/></body>'
        '<body name="shell"><freejoint/><geom type="mesh" mesh="shell" mass="1"/></body></worldbody></mujoco>'
    )
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "shell.xml")},
        "objects": {"shell": {"body": "shell", "material": "wood"}},
        "sensors": {
            "heat": {
                "kind": "temperature_grid", "links": "tip", "feels": ["shell"], "cells": [1, 1, 1], "material": "steel"
            }
        },
    }  # fmt: skip
    with pytest.raises(tgdsl.SpecError, match=r'objects\.shell.*: the geoms of body "shell" enclose no volume'):
        tgdsl.compile(document)


def test_an_area_by_hertz_needs_a_stiffness(tmp_path):
    """If neither side had a stiffness, a point contact would have no area and pass no heat."""
    material = {"conductivity": 200.0, "density": 2700.0, "specific_heat": 900.0, "emissivity": 0.1}
    ball = {"ball": ([0.02] * 3, {"material": material, "temperature": 45.0})}
    with pytest.raises(tgdsl.SpecError, match=r"objects\.ball\.material: neither .* has a `youngs_modulus`.*`contact_area`"):
        heat_module(tmp_path, {"tip": [0.01] * 3}, {"cells": [1, 1, 1], "material": material}, ball)
    heat_module(tmp_path, {"tip": [0.01] * 3}, {"cells": [1, 1, 1], "material": material, "contact_area": "1 mm2"}, ball)


def test_rows_of_one_number_per_link_name_links(tmp_path):
    for outputs in ("cells", "max", "mean"):
        module = heat_module(
            tmp_path, {"a": [0.01] * 3, "b": [0.02] * 3}, {"material": "steel", "cells": [1, 1, 1], "outputs": outputs}
        )
        assert module.rows["heat"]["link"].tolist() == ["a", "b"]
