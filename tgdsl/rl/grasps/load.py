"""The grasps of a task: from its file, from the user's cache, or sampled now."""

from __future__ import annotations

from dataclasses import replace

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import SimulationError
from tgdsl.files.cache import cached
from tgdsl.plan.scene import SceneFile
from tgdsl.rl.grasps.grasps import Grasps, cache_key, read_grasps, settings_of
from tgdsl.rl.grasps.sampling import Found, sample
from tgdsl.rl.grasps.spec import grasp_spec
from tgdsl.rl.grasps.table import GraspTable
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.task import Setup
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.scene.digest import scene_digest


def with_grasps(setup: Setup, loaded: LoadedTask, sim: Simulation, scene: SceneFile, progress: Progress | None = None) -> Setup:
    """Return what a task is made for, with its grasps if its document has any; the simulation has to be reset afterwards.

    Raises:
        SpecError: If the document's file of grasps is none of this scene, hardly any grasp holds, or a variant has none.
    """
    spec = grasp_spec(loaded.spec)
    if spec is None:
        return setup
    tell = progress or silent
    joints = setup.actuators.names
    try:
        if spec.file is not None:
            grasps = read_grasps(loaded.folder / spec.file, scene_digest(scene), loaded.spec.object)
        else:
            grasps = kept_grasps(loaded, scene, joints, lambda num, of: tell(f"sampling grasps: {num} of {of}"), progress)
        return replace(setup, grasps=GraspTable(grasps, sim, setup.object, setup.variant, setup.draws))
    except SimulationError as error:
        raise loaded.error(("grasps",) if spec.file is None else ("grasps", "file"), str(error)) from error


def kept_grasps(
    loaded: LoadedTask, scene: SceneFile, joints: tuple[str, ...], found: Found, progress: Progress | None = None
) -> Grasps:
    """Return the grasps of the user's cache; those that it does not have are sampled now, which takes a minute or more.

    They are kept under a hash of the scene and of all settings, so these are found again.

    Raises:
        SpecError: If there is no such keyframe, the object cannot be held as asked, or hardly any grasp holds.
    """
    key = cache_key(scene_digest(scene), settings_of(loaded.spec, joints))
    return cached(key, lambda: sample(loaded, found, progress), Grasps.packed, Grasps.unpacked)
