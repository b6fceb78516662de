"""Cameras of a hand's pictures: views by name or angle, and the view that shows most.

Shapes: `taxel` taxels of one sensor or layout.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.layout.layout import Layout
from tgdsl.view.markers import Markers, Pose, is_visible, taxels_of
from tgdsl.view.raster import Camera, Mesh, rasterise, unit, viewport_for

Array = np.ndarray
# where the camera is, from the taxels' mean normal: degrees round the hand to the picture's right, and degrees up
VIEWS = {
    "front": (6.0, 16.0),
    "back": (186.0, 16.0),
    "left": (-70.0, 10.0),
    "right": (70.0, 10.0),
    "top": (0.0, 90.0),
    "bottom": (0.0, -90.0),
    "iso": (36.0, 32.0),
}
# length of the mean unit normal below which taxels have no common side, but look at each other, as a gripper's pads do
OPPOSED = 0.2
_PAST_NEAR_PAD = np.radians(35.0)  # angle between the camera and the plane of opposed pads, so that one pad's face shows
_CANDIDATES = (*VIEWS, *(f"{around},{rise}" for rise in (-30, 16, 50) for around in range(0, 360, 45)))
_LOOK = 200  # columns and rows of the pictures by which views are compared


class ViewError(TgdslError):
    """A picture that cannot be drawn from its arguments."""


def angles_of(view: str) -> tuple[float, float]:
    """Return azimuth and elevation [degrees] of a view: one of `VIEWS`, or the two numbers themselves, such as "30,20"."""
    if view in VIEWS:
        return VIEWS[view]
    azimuth, comma, elevation = view.partition(",")
    if not comma:
        raise ViewError(f'there is no view "{view}"; {did_you_mean(view, VIEWS, "views")}')
    try:
        angles = float(azimuth), float(elevation)
    except ValueError:
        angles = np.nan, np.nan
    if not (np.isfinite(angles).all() and abs(angles[1]) <= 90):
        raise ViewError(f'there is no view "{view}"; expected azimuth and elevation in degrees, the latter from -90 to 90')
    return angles


def pose_of(model: mujoco.MjModel, keyframe: str | None) -> Pose:
    """Return where a keyframe puts the bodies; without one, where the model's own initial state does."""
    state = mujoco.MjData(model)
    if keyframe is not None:
        names = [model.key(i).name for i in range(model.nkey)]
        if keyframe not in names:
            raise ViewError(f'the scene has no keyframe "{keyframe}"; {did_you_mean(keyframe, names, "keyframes")}')
        mujoco.mj_resetDataKeyframe(model, state, names.index(keyframe))
    mujoco.mj_kinematics(model, state)
    return Pose(state.xpos.copy(), state.xquat.copy())


def camera_of(view: str, model: mujoco.MjModel, layouts: Sequence[Layout], pose: Pose, root: int) -> Camera:
    """Return the camera of a view: fixed to the hand's first body, so that a closing hand keeps its side to the camera.

    Up is the axis of the root's frame along which the taxels lie farthest from its origin, among axes not pointing at the
    camera. For opposed taxels up is against gravity, and the camera looks across the gap between them, rotated until one side's
    faces show. Taxels count in the model's initial state, weighted by area.
    """
    initial = pose_of(model, None)
    taxels = [taxels_of(model, initial, layout) for layout in layouts]
    weight = np.concatenate([each.size**2 for each in taxels])
    centre = weight @ np.concatenate([each.pos for each in taxels]) / weight.sum()
    normals = np.concatenate([each.normal for each in taxels])
    mean = weight @ normals / weight.sum()
    normal = unit(mean, np.zeros(3))
    axes = Rotation.from_quat(initial.quat[root], scalar_first=True).as_matrix().T
    axes = np.concatenate([axes, -axes])
    across = axes[np.abs(axes @ normal) < 0.7]
    up = across[np.argmax(across @ (centre - initial.pos[root] + [0, 0, 1e-6]))]  # the world's z, where nothing else decides
    toward = unit(normal - (normal @ up) * up, axes[np.argmin(np.abs(axes @ up))])
    if np.linalg.norm(mean) < OPPOSED:
        up = unit(-model.opt.gravity, np.array([0.0, 0.0, 1.0]))
        level = normals - np.outer(normals @ up, up)
        along = np.linalg.eigh((level * weight[:, None]).T @ level)[1][:, -1]
        along = along * np.sign(along[np.abs(along).argmax()])
        toward = np.cos(_PAST_NEAR_PAD) * np.cross(along, up) + np.sin(_PAST_NEAR_PAD) * along
    around, rise = np.radians(angles_of(view))
    level = np.cos(around) * toward + np.sin(around) * np.cross(up, toward)
    toward = np.cos(rise) * level + np.sin(rise) * up
    right = np.cross(up, level)
    turn = Rotation.from_quat(pose.quat[root], scalar_first=True).as_matrix() @ axes[:3]
    right, above, toward = np.stack([right, np.cross(toward, right), toward]) @ turn.T
    return Camera(right, above, toward, pose.pos[root])


def facing_camera(markers: Markers, origin: Float[Array, " 3"]) -> Camera:
    """Return a camera that the most strongly read taxels face, a little from the side; where none reads, all count alike.

    The image's up is the world's, or else leads away from where the hand begins: `origin` [m].
    """
    weight = markers.value if markers.is_read.any() else np.ones(len(markers.value))
    toward = unit(weight @ markers.normal, np.array([0.0, 0.0, 1.0]))
    along = markers.pos.mean(axis=0) - origin
    for up in (np.array([0.0, 0.0, 1.0]), along, np.array([0.0, 1.0, 0.0])):
        across = up - (up @ toward) * toward
        if np.linalg.norm(across) > 0.5 * np.linalg.norm(up) > 0:
            break
    up = unit(across, up)
    toward = unit(toward - 0.38 * up + 0.28 * np.cross(up, toward), toward)
    right = unit(np.cross(up, toward), up)
    return Camera(right, np.cross(toward, right), toward, markers.pos.mean(axis=0))


def best_camera(markers: Markers, hand: Mesh, model: mujoco.MjModel, layout: Layout, pose: Pose, root: int) -> Camera:
    """Return the camera that those taxels face which read most (see `facing_camera`), or the one that shows most taxels.

    It counts touched taxels, or all if none is touched. The first camera wins if it shows at least half as many as any other;
    it is `front` where the taxels are opposed. `hand` hides taxels; `layout` has the taxels that views are named after.
    """
    targets = markers.is_touched if markers.is_touched.any() else markers.size > 0
    weight = markers.value if markers.is_read.any() else np.ones(len(markers.value))
    is_opposed = np.linalg.norm(weight @ markers.normal) < OPPOSED * weight.sum()
    first = camera_of("front", model, [layout], pose, root) if is_opposed else facing_camera(markers, pose.pos[root])
    num_seen, _ = _count_visible(markers, targets, hand, first)
    if 2 * num_seen >= targets.sum():
        return first
    candidates = [camera_of(view, model, [layout], pose, root) for view in _CANDIDATES]
    counts = [_count_visible(markers, targets, hand, camera) for camera in candidates]
    most = max(counts)
    return first if 2 * num_seen >= most[0] else candidates[counts.index(most)]


def _count_visible(markers: Markers, targets: Array, hand: Mesh, camera: Camera) -> tuple[int, int]:
    """Return how many target taxels a camera shows, and how many taxels in all."""
    corners = hand.corners[hand.normals.mean(axis=1) @ camera.toward > 0]
    flat = np.concatenate([camera.project(corners).reshape(-1, 3), camera.project(markers.pos)])[:, :2]
    margin = 1e-3  # [m] so that a single point has a size too
    viewport = viewport_for(camera, np.stack([flat.min(axis=0) - margin, flat.max(axis=0) + margin]), _LOOK, _LOOK)
    fragments = rasterise(viewport.project(corners), _LOOK, _LOOK)
    seen = is_visible(markers, viewport.project(markers.pos), fragments, camera) & (markers.size > 0)
    return int((seen & targets).sum()), int(seen.sum())
