"""A hash of what is simulated, whatever a module reads of it."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET

from tgdsl.plan.scene import SceneFile


def scene_digest(scene: SceneFile) -> str:
    """Return a hash of a scene: its files, assets, objects and colliders, without the contact sensors that a module wants."""
    root = ET.fromstring(scene.mjcf)
    for sensors in root.findall("sensor"):
        for sensor in [element for element in sensors if element.get("name", "").startswith("tgdsl/")]:
            sensors.remove(sensor)
        if not len(sensors):
            root.remove(sensors)
    texts = [ET.tostring(root, encoding="unicode"), *scene.parts.values(), repr(scene.objects)]
    texts += [repr(scene.colliders)] if scene.colliders else []
    result = hashlib.sha256(b"tgdsl scene 1")
    for part in [*texts, *sorted(asset.sha256 for asset in scene.assets)]:
        result.update(f"{len(part)} {part}".encode())
    return result.hexdigest()
