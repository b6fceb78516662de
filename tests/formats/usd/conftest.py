"""Exported stages that several tests share."""

import mujoco
import pytest
from pxr import Usd
from usd_exports import XHAND1, ZOO, exported

from tgdsl.formats.robot import export_model


@pytest.fixture(scope="module")
def zoo(tmp_path_factory) -> tuple[Usd.Stage, mujoco.MjModel]:
    return exported(tmp_path_factory.mktemp("zoo"), ZOO)


@pytest.fixture(scope="module")
def hand(tmp_path_factory) -> tuple[Usd.Stage, mujoco.MjModel]:
    out = tmp_path_factory.mktemp("hand") / "hand.usdc"
    export_model(XHAND1, out)
    return Usd.Stage.Open(str(out)), mujoco.MjModel.from_xml_path(str(XHAND1))


@pytest.fixture(params=["zoo", "hand"])
def pair(request) -> tuple[Usd.Stage, mujoco.MjModel]:
    return request.getfixturevalue(request.param)
