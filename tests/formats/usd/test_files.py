"""USD files of every kind, and MJCF files written from them."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import UsdUtils
from stages import (
    ODD,
    WEDGE,
    WEDGE_FACES,
    add_body,
    add_mesh,
    call,
    new_stage,
    path_of,
)

from tgdsl.formats.mjcf import write_mjcf
from tgdsl.formats.robot import load_model
from tgdsl.formats.usd.reader import usd_to_mjcf


@pytest.mark.parametrize("suffix", ["usd", "usda", "usdc", "usdz"])
def test_every_kind_of_file_is_read(tmp_path, suffix):
    stage = new_stage(tmp_path, "robot.usda" if suffix == "usdz" else f"robot.{suffix}")
    add_body(stage, "/b")
    path = path_of(stage)
    if suffix == "usdz":
        path = tmp_path / "robot.usdz"
        assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "robot.usda"), str(path))
    assert load_model(path).bodies == ("world", "b")


def test_written_files_give_the_model_of_the_text(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b", mass=0)
    add_mesh(stage, "/b/wedge", np.array(WEDGE) / 3, WEDGE_FACES, pos=(0.1, 0.2, 0.3), quat=ODD)
    named = add_mesh(stage, "/b/odd", np.array(WEDGE) / 7, WEDGE_FACES)
    call(named, "../Wedge")
    text = usd_to_mjcf(path_of(stage))
    out = tmp_path / "out" / "hand.xml"
    out.parent.mkdir()
    for _ in range(2):  # existing files are replaced
        write_mjcf(text, out)
        assert sorted(p.relative_to(out.parent).as_posix() for p in out.parent.rglob("*")) == [
            "hand.xml",
            "hand_assets",
            "hand_assets/.._Wedge.obj",
            "hand_assets/wedge.obj",
        ]
    inline, written = mujoco.MjModel.from_xml_string(text), mujoco.MjModel.from_xml_path(str(out))
    for name in ("mesh_vert", "mesh_face", "geom_pos", "geom_quat", "body_mass", "body_inertia", "body_ipos"):
        np.testing.assert_array_equal(getattr(inline, name), getattr(written, name), err_msg=name)


def test_written_files_have_a_line_for_each_element(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    write_mjcf(usd_to_mjcf(path_of(stage)), tmp_path / "hand.xml")
    lines = (tmp_path / "hand.xml").read_text().splitlines()
    assert len(lines) > 2 and all(line.count("<") == 1 for line in lines)


def test_no_partial_files_are_left(tmp_path, monkeypatch):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    add_mesh(stage, "/b/wedge", WEDGE, WEDGE_FACES)
    text = usd_to_mjcf(path_of(stage))

    def full(*_, **__):
        raise OSError("no space left on device")

    files_before = sorted(tmp_path.iterdir())
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="no space"):
        write_mjcf(text, tmp_path / "hand.xml")
    assert sorted(tmp_path.iterdir()) == files_before


def test_numbers_keep_all_their_digits(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b", (1 / 3, math.pi, 1e-7))
    assert 'pos="0.3333333333333333 3.141592653589793 1e-07"' in usd_to_mjcf(path_of(stage))
