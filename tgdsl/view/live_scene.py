"""The scene of the live page: robot and objects, readings on them, arrows, contacts and the name of a picked row."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.layout.layout import Link
from tgdsl.module.outputs import Output
from tgdsl.view.cameras import facing_camera
from tgdsl.view.layers import LIFT, Layer, Rows, Shown, SurfaceLayer, layer_of
from tgdsl.view.markers import THRESHOLDS, Markers, Pose
from tgdsl.view.meshes import body_surfaces, robot_bodies, shapes_of
from tgdsl.view.stages import Contacts, Poses, Stage
from tgdsl.view.style import LIVE_OBJECT, LIVE_OTHER, LIVE_SENSING

Array = np.ndarray
ARROW = 0.03  # length of the arrow of the largest vector so far [m]
_FORCE, _CONTACT = (30, 30, 30), (190, 24, 120)
_CONTACT_SIZE = 0.0025  # width of a contact point [m]


class LiveScene:
    """Nodes of viser's scene that show a stage; `/body<id>` is the frame of a body."""

    def __init__(self, server: Any, stage: Stage, outputs: Mapping[str, Output], pick: Callable[[int], None]):
        self._server, self._stage, self._outputs, self._pick = server, stage, outputs, pick
        self._links = stage.touch.plan.layout.links
        self._carriers = {stage.model.body(link.body).id for link in self._links}
        self._carriers |= {stage.model.body(name).id for output in outputs.values() for name in output.bodies}
        self._near, robot = robot_bodies(stage.model, self._carriers)
        self.robot = frozenset(robot | {0})
        scene = server.scene
        self.frames = {body: scene.add_frame(f"/body{body}", show_axes=False) for body in range(stage.model.nbody)}
        self._meshes: dict[int, list[tuple[Any, Any]]] = {}
        for body in range(stage.model.nbody):
            self._add_body(stage.model, body)
        self._shapes = shapes_of(stage.model)
        self.layers: list[Layer] = []
        self._arrows = scene.add_line_segments("/arrows", np.zeros((1, 2, 3)), _FORCE, thickness=2.0, thickness_units="screen")
        self._points = scene.add_point_cloud(
            "/contacts", np.zeros((1, 3)), _CONTACT, point_size=_CONTACT_SIZE, point_shape="circle", precision="float32"
        )
        self._forces = scene.add_arrows(
            "/contact_forces", np.zeros((1, 2, 3)), _CONTACT, shaft_radius=0.0005, head_radius=0.0014, head_length=0.004
        )
        self._name = scene.add_label("/picked", "", font_screen_scale=0.9, anchor="bottom-left")
        for handle in (self._arrows, self._points, self._forces, self._name):
            handle.visible = False
        self._largest_contact = THRESHOLDS["N"]  # smaller forces are rounding, and their arrows too short to draw

    def move(self, poses: Poses, env: int) -> None:
        """Put the bodies where they are; redraw objects that have another shape in this environment."""
        for frame, pos, quat in zip(self.frames.values(), *poses, strict=True):
            frame.position, frame.wxyz = pos, quat  # viser sends changes only
        model = self._stage.env_model(env)
        if model is not self._stage.model and (shapes := shapes_of(model)) != self._shapes:
            self._shapes = shapes
            for body in set(self.frames) - self.robot:
                for mesh, _ in self._meshes.pop(body):
                    mesh.remove()
                self._add_body(model, body)

    def show_readings(self, names: Iterable[str]) -> None:
        """Replace the drawn readings; the first is the chosen one."""
        for layer in self.layers:
            layer.remove()
        self.layers = [
            layer_of(self._server.scene, self._stage.model, self._stage.touch, self._outputs[name], rank, self._pick)
            for rank, name in enumerate(names)
        ]

    def show(self, *, robot: bool, objects: bool, taxels: bool, plain: bool, links: set[str]) -> None:
        """Switch parts on and off; `plain` draws the robot in grey."""
        surfaces = [layer for layer in self.layers if isinstance(layer, SurfaceLayer)]
        covered = frozenset[int]().union(*(layer.bodies for layer in surfaces)) if taxels else frozenset()
        for body, meshes in self._meshes.items():
            is_shown = (robot if body in self.robot else objects) and body not in covered
            for mesh, colour in meshes:
                mesh.visible = is_shown
                if body in self.robot:
                    mesh.color = self._plain(body) if plain or colour is None else colour
        for layer in self.layers:
            layer.show(links if taxels else ())

    def draw_arrows(self, rows: Rows, shown: Shown, poses: Poses, is_shown: Array) -> None:
        """Draw the vectors of a reading from the rows that are shown; no vectors: nothing."""
        drawn = np.flatnonzero((shown.value > 0) & is_shown) if shown.vector is not None else ()
        self._arrows.visible = len(drawn) > 0
        if shown.vector is None or not len(drawn):
            return
        pos, quat = poses
        turn = Rotation.from_quat(quat[rows.body[drawn]], scalar_first=True)
        begin = pos[rows.body[drawn]] + turn.apply(rows.pos[drawn] + LIFT * rows.normal[drawn])
        along = turn.apply(shown.vector[drawn]) * ARROW / float(shown.norm.vmax or 1.0)
        self._arrows.points = np.stack([begin, begin + along], axis=1).astype(np.float32)

    def draw_contacts(self, contacts: Contacts | None) -> None:
        """Draw contact points, and the forces on the robot, or else on the second body, as arrows; None: nothing."""
        num = 0 if contacts is None else len(contacts.pos)
        self._points.visible, self._forces.visible = num > 0, False
        if contacts is None or not num:
            return
        self._points.points = contacts.pos.astype(np.float32)
        if contacts.force is None:
            return
        force = contacts.forces_on(self.robot)
        size = np.linalg.norm(force, axis=1)
        self._largest_contact = max(self._largest_contact, float(size.max()))
        along = ARROW / self._largest_contact * force
        drawn = np.linalg.norm(along, axis=1) > 1e-3
        if drawn.any():
            self._forces.points = np.stack([contacts.pos, contacts.pos + along], axis=1)[drawn].astype(np.float32)
            self._forces.visible = True

    def name_row(self, rows: Rows, row: int | None, poses: Poses, text: str = "") -> None:
        """Write text next to a row; None: hide the text."""
        self._name.visible = row is not None
        if row is not None:
            pos, quat = (part[rows.body[row]] for part in poses)
            turn = Rotation.from_quat(quat, scalar_first=True)
            self._name.position = pos + turn.apply(rows.pos[row] + 4 * LIFT * rows.normal[row])
            self._name.text = text

    def place_camera(self, rows: Rows) -> None:
        """Look at the rows of a reading from where most of them face."""
        pose = Pose(*self._stage.body_poses(0))
        turn = Rotation.from_quat(pose.quat[rows.body], scalar_first=True)
        pos, normal = pose.pos[rows.body] + turn.apply(rows.pos), turn.apply(rows.normal)
        aim_camera(self._server, Markers(pos, normal, rows.size, np.zeros(len(pos)), "", ""), pose.pos[min(self._near)])

    def _add_body(self, model: mujoco.MjModel, body: int) -> None:
        is_plain = body in self.robot
        self._meshes[body] = add_body(self._server.scene, model, body, self._links, self._plain(body), is_plain)

    def _plain(self, body: int) -> tuple[int, int, int]:
        return LIVE_SENSING if body in self._carriers else LIVE_OTHER if body in self.robot else LIVE_OBJECT


def add_body(
    scene: Any, model: mujoco.MjModel, body: int, links: Iterable[Link], colour: tuple[int, int, int], is_plain: bool
) -> list[tuple[Any, Any]]:
    """Add a mesh for each colour of a body to viser's scene; return their handles and colours, None where it has none.

    Args:
        scene: Viser's scene, where `/body<id>` is the frame of the body.
        model: The compiled scene.
        body: Index of the body.
        links: The links with taxels; see `body_surfaces`.
        colour: Red, green and blue of parts without a colour.
        is_plain: Whether all parts have that colour.
    """
    meshes = []
    for i, (corners, normals, rgba) in enumerate(body_surfaces(model, body, links)):
        rgb = None if rgba is None else tuple(round(255 * part) for part in rgba[:3])
        style = {"color": colour if is_plain or rgb is None else rgb, "opacity": rgba[3] if rgba and rgba[3] < 1 else None}
        mesh = scene.add_mesh_simple(f"/body{body}/mesh{i}", *_joined(corners, normals), **style)
        meshes.append((mesh, rgb))
    return meshes


def aim_camera(server: Any, markers: Markers, origin: Float[Array, " 3"]) -> None:
    """Have the camera look at rows from where most of them face; `origin` is where the hand begins [m]."""
    camera, pos = facing_camera(markers, origin), markers.pos
    centre = 0.5 * (pos.min(axis=0) + pos.max(axis=0))
    reach = max(0.03, float(np.linalg.norm(pos - centre, axis=1).max()))
    initial = server.initial_camera
    initial.position, initial.look_at, initial.up = centre + 2.0 * reach * camera.toward, centre, camera.up
    initial.near = 0.1 * reach


def _joined(corners: Float[Array, "face 3 3"], normals: Float[Array, "face 3 3"]) -> tuple[Array, Array]:
    """Return vertices and faces; corners are one vertex where place and normal agree, so that edges stay sharp."""
    both = np.concatenate([corners.reshape(-1, 3) * 1e6, normals.reshape(-1, 3) * 1e3], axis=1).round().astype(np.int64)
    _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
    return corners.reshape(-1, 3)[first].astype(np.float32), inverse.reshape(-1, 3).astype(np.uint32)
