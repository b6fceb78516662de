"""Which bodies of the scene a document's objects are, what geoms they have, and what is felt of them."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import mujoco

from tgdsl.compiler.sensed import sensed_object
from tgdsl.compiler.variants import Meshes, NewBody, OwnObjects, scene_object, variant_scenes, with_bodies
from tgdsl.errors import did_you_mean
from tgdsl.formats.model import Model
from tgdsl.plan.scene import SceneObject
from tgdsl.scene.contact_bits import bits_that_meet
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.yaml import Path
from tgdsl.surfaces.sensed import SensedObject


def own_objects(loaded: Loaded, scene: Model, links: Set[str]) -> tuple[Model, OwnObjects]:
    """Return the scene with the bodies that the document adds, and the objects that have geoms or sizes of their own.

    Args:
        loaded: The document; mistakes are noted in it.
        scene: The scene as its file has it.
        links: Bodies that carry taxels.
    """
    bodies, objects, meshes = _new_bodies(loaded, scene), [], Meshes()
    scene = with_bodies(scene, bodies)
    body_of = {name: target.body_of(name) for name, target in loaded.spec.objects.items()}
    for name, target in loaded.spec.objects.items():
        body = body_of[name]
        if not (target.compounds or target.size == "per_env") or body not in scene.bodies:
            continue

        def report(place: Path, what: str, hint: str = "", name: str = name) -> None:
            loaded.problems.append(loaded.problem(("objects", name, *place), what, hint))

        others = [other for other, part in body_of.items() if part == body and other != name]
        rigid = [scene.compiled.body(i).name for i in scene.rigid_bodies(body, _others(loaded, body))]
        if carrying := [part for part in rigid if part in links]:
            report(("body",), f'body "{carrying[0]}" carries taxels, so its geoms cannot be others')
        elif others:
            report(("body",), f'the geoms of body "{body}" are this object\'s, but object "{others[0]}" has it too')
        elif not any(geom.body == body for geom in scene.geoms):
            report(("body",), f'body "{body}" has no geom', "its first geom says what `geom` does not, such as friction")
        else:
            own = scene_object(name, target, loaded.folder, meshes, report)
            objects.append(replace(own, others=tuple(sorted(_others(loaded, body)))))
    return scene, OwnObjects(bodies, tuple(objects), meshes)


def _others(loaded: Loaded, body: str) -> set[str]:
    """Return the bodies of the objects that are not of a body."""
    return {target.body_of(name) for name, target in loaded.spec.objects.items()} - {body}


def _new_bodies(loaded: Loaded, scene: Model) -> tuple[NewBody, ...]:
    compiler, new = scene.spec.compiler, []
    is_forced = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    low = int(compiler.inertiagrouprange[0])
    group = low if is_forced and low > 0 else 0
    contype, conaffinity = bits_that_meet(scene.spec.geoms)
    for name, target in loaded.spec.objects.items():
        if target.body is None and name in scene.bodies:
            what = f'the scene has a body "{name}" already'
            loaded.problems.append(loaded.problem(("objects", name), what, f"`body: {name}` gives that one these geoms"))
        elif target.body is None:
            pos, quat = target.pos or (0.0, 0.0, 0.0), target.quat or (1.0, 0.0, 0.0, 0.0)
            bits = [
                default if own is None else own
                for own, default in ((target.contype, contype), (target.conaffinity, conaffinity))
            ]
            new.append(NewBody(name, pos, quat, target.joint != "fixed", group, *bits))
    return tuple(new)


def sensed_objects(loaded: Loaded, scene: Model, own: OwnObjects) -> dict[str, SensedObject]:
    """Return the objects that some sensor feels."""
    felt = {name for sensor in loaded.spec.sensors.values() for name in sensor.objects}
    with_geoms: dict[str, SceneObject] = {target.name: target for target in own.objects if target.types}
    is_faulty = bool(loaded.problems)
    objects: dict[str, SensedObject] = {}
    for name, target in loaded.spec.objects.items():
        path: Path = ("objects", name, "body" if target.body is not None else "geom")
        body = target.body_of(name)
        if body not in scene.bodies:
            hint = did_you_mean(body, scene.bodies, "bodies")
            loaded.problems.append(loaded.problem(path, f'no body is named "{body}"', hint))
            continue
        if (target.compounds or target.size == "per_env") and is_faulty:
            continue  # what is wrong with its geoms is known already

        def report(what: str, hint: str, at: Path = path) -> None:
            loaded.problems.append(loaded.problem(at, what, hint))

        variants = variant_scenes(scene, with_geoms[name], own.meshes.contents) if target.compounds else []
        found = sensed_object(name, body, target, scene, variants, _others(loaded, body), report)
        if name in felt:
            objects[name] = found
    return objects
