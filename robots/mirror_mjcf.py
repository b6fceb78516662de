"""Mirror a hand's MJCF file and the meshes that it names.

A hinge turns about −M a, hence the same joint values put the left hand into the mirrored pose, and ranges, drives and keyframes
are the same on both hands. What may hold geometry and is not known here is refused by name.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from reflection import Mirror, MirrorError, Signs, flipped, mirrored_stl, same_triangles, signed

# ---- what is known of elements and attributes

POSE = "pos quat euler axisangle xyaxes zaxis"
ACTUATOR = (
    "name class group joint jointinparent tendon body nsample interp delay"
    " ctrllimited forcelimited actlimited ctrlrange forcerange actrange lengthrange inheritrange gear damping armature"
    " dyntype gaintype biastype dynprm gainprm biasprm actdim actearly kp kv dampratio timeconst diameter area bias"
    " range force scale lmin lmax vmax fpmax fvmax gain"
)
ACTUATORS = "general motor position velocity intvelocity damper cylinder muscle adhesion"
CONTACT = "condim friction solreffriction solref solimp margin gap"
EQUALITY = "name class active solref solimp"
SENSOR = (
    "name cutoff noise nsample interp delay interval site joint tendon actuator body geom objtype objname reftype refname"
    " body1 body2 geom1 geom2 subtree1 subtree2 num data reduce"
)
SENSORS = (
    "touch accelerometer velocimeter gyro force torque magnetometer jointpos jointvel tendonpos tendonvel actuatorpos"
    " actuatorvel actuatorfrc jointactuatorfrc tendonactuatorfrc jointlimitpos jointlimitvel jointlimitfrc tendonlimitpos"
    " tendonlimitvel tendonlimitfrc framepos framequat framexaxis frameyaxis framezaxis framelinvel frameangvel framelinacc"
    " frameangacc subtreecom subtreelinvel subtreeangmom distance clock contact"
)
TENDON = (
    "name class group limited range actuatorfrclimited actuatorfrcrange solreflimit solimplimit solreffriction"
    " solimpfriction margin frictionloss springlength width material rgba stiffness damping armature"
)
ANYTHING = "*"
"""Elements that hold no geometry at all."""

ATTRIBUTES = {
    "mujoco": "model",
    "compiler": "autolimits boundmass boundinertia settotalmass balanceinertia angle fitaabb eulerseq meshdir texturedir"
    " assetdir discardvisual usethread fusestatic inertiafromgeom inertiagrouprange saveinertial alignfree",
    "option": "timestep impratio tolerance ls_tolerance noslip_tolerance ccd_tolerance sleep_tolerance density viscosity"
    " o_margin o_solref o_solimp o_friction integrator cone jacobian solver iterations ls_iterations noslip_iterations"
    " ccd_iterations sdf_iterations sdf_initpoints actuatorgroupdisable",
    "statistic": "meaninertia meanmass meansize extent center",
    **dict.fromkeys(("flag", "size", "visual", "default", "texture", "material", "layer"), ANYTHING),
    **dict.fromkeys(("asset", "worldbody", "contact", "equality", "tendon", "actuator", "sensor", "keyframe"), ""),
    "mesh": "name class file scale inertia smoothnormal maxhullvert octree_maxdepth refpos refquat vertex face",
    "body": f"name childclass mocap gravcomp sleep {POSE}",
    "frame": f"name childclass {POSE}",
    "inertial": f"mass diaginertia fullinertia {POSE}",
    "joint": "name class type group axis pos springdamper limited actuatorfrclimited actuatorfrcrange actuatorgravcomp"
    " solreflimit solimplimit solreffriction solimpfriction stiffness range margin ref springref armature damping frictionloss",
    "geom": f"name class type contype conaffinity group priority size material mass density shellinertia solmix rgba mesh"
    f" fitscale fluidshape fluidcoef fromto {CONTACT} {POSE}",
    "site": f"name class type group material size rgba fromto {POSE}",
    "camera": "name class mode target fovy ipd resolution orthographic projection pos quat xyaxes",
    "default/camera": "mode fovy ipd resolution orthographic projection",
    "exclude": "name body1 body2",
    "pair": f"name class geom1 geom2 {CONTACT}",
    "connect": f"{EQUALITY} body1 body2 site1 site2 anchor",
    "weld": f"{EQUALITY} body1 body2 site1 site2 anchor relpose torquescale",
    "equality/joint": f"{EQUALITY} joint1 joint2 polycoef",
    "equality/tendon": f"{EQUALITY} tendon1 tendon2 polycoef",
    "default/equality": EQUALITY,
    "spatial": TENDON,
    "fixed": TENDON,
    "default/tendon": TENDON,
    "spatial/site": "site",
    "spatial/geom": "geom sidesite",
    "spatial/pulley": "divisor",
    "fixed/joint": "joint coef",
    **dict.fromkeys(ACTUATORS.split(), ACTUATOR),
    **{f"sensor/{tag}": SENSOR for tag in SENSORS.split()},
    "key": "name time qpos qvel act ctrl",
}
"""Known attributes by element, or by parent/element where the same name means something else there."""

NAMES = (
    "name model body body1 body2 geom geom1 geom2 joint joint1 joint2 jointinparent site site1 site2 mesh material texture"
    " tendon tendon1 tendon2 target actuator sidesite objname refname subtree1 subtree2"
)
"""Attributes that name something; classes keep their names."""

SIGNS: Mapping[str, Callable[[Mirror], Signs]] = {
    **dict.fromkeys(("pos", "refpos", "anchor", "center"), lambda m: m.polar),
    **dict.fromkeys(("quat", "refquat"), lambda m: (1, *m.axial)),
    "axisangle": lambda m: (*m.axial, 1),
    "xyaxes": lambda m: tuple(m.polar[column] * sign for column in (0, 1) for sign in m.polar),
    "zaxis": lambda m: tuple(m.polar[2] * sign for sign in m.polar),
    "fromto": lambda m: (*m.polar, *m.polar),
    "fullinertia": lambda m: (1, 1, 1, *(m.polar[i] * m.polar[j] for i, j in ((0, 1), (0, 2), (1, 2)))),
    "relpose": lambda m: (*m.polar, 1, *m.axial),
}
"""The signs of attributes that mean the same in every element that has them."""


# ---- text in, text out


@dataclass(eq=False)
class Element:
    """A start tag of a file; its attributes are replaced in place.

    Attributes:
        tag: Its name.
        line: Its line, from 1.
        parent: The element that it is in.
        attributes: The text of each attribute.
        spaces: What stands before each attribute.
        end: How the tag ends.
    """

    tag: str
    line: int
    parent: Element | None
    attributes: dict[str, str]
    spaces: dict[str, str]
    end: str

    @property
    def key(self) -> str:
        """The key of the attributes that are known of it."""
        outer = self.parent.tag if self.parent else ""
        inside = f"{outer}/{self.tag}"
        return "visual" if outer == "visual" else inside if inside in ATTRIBUTES or outer == "sensor" else self.tag

    def __str__(self) -> str:
        given = (f'{self.spaces.get(name, " ")}{name}="{value}"' for name, value in self.attributes.items())
        return f"<{self.tag}{''.join(given)}{self.end}"


_TAG = re.compile(r"<!--.*?-->|<\?.*?\?>|</[^>]*>|<([\w.-]+)((?:\s+[\w.:-]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*)(\s*/?>)", re.DOTALL)
_ATTRIBUTE = re.compile(r"(\s+)([\w.:-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")


def pieces(text: str, mirror: Mirror) -> list[str | Element]:
    """Return a file's text from its root element on, cut at the start tags.

    Comments in the tree of bodies speak of the right hand's numbers and are left out, as are those above the root.
    """
    found: list[str | Element] = []
    stack: list[Element] = []
    at = 0
    for match in _TAG.finditer(text):
        found.append(text[at : match.start()])
        at = match.end()
        if match[0].startswith("<!--"):
            if any(element.tag == "worldbody" for element in stack):
                found[-1] = re.sub(r"\n?[ \t]*\Z", "", str(found[-1]))
            else:
                found.append(mirror.renamed(match[0]))
        elif match[1] is None:
            found.append(match[0])
            if match[0].startswith("</"):
                stack.pop()
        else:
            element = _element(match, text.count("\n", 0, match.start()) + 1, stack[-1] if stack else None)
            if not stack:
                found.clear()
            found.append(element)
            if not match[3].endswith("/>"):
                stack.append(element)
    return [*found, text[at:]]


def _element(match: re.Match[str], line: int, parent: Element | None) -> Element:
    given = _ATTRIBUTE.findall(match[2])
    attributes = {name: double or single.replace('"', "&quot;") for _, name, double, single in given}
    return Element(match[1], line, parent, attributes, {name: space for space, name, *_ in given}, match[3])


@dataclass(eq=False)
class ModelMirror:
    """Mirrors one MJCF file.

    Attributes:
        file: The file.
        mirror: The reflection.
        outputs: Content of each file to write, by path; meshes are added as they are met.
        euler: The letters of the compiler's `eulerseq`.
        mesh_folder: Where mesh files are looked up.
        joint_defaults: Attributes that a default class gives joints, by class.
        parent_class: The class that a class is in.
    """

    file: Path
    mirror: Mirror
    outputs: dict[Path, bytes] = field(default_factory=dict)
    euler: str = "xyz"
    mesh_folder: Path = Path()
    joint_defaults: dict[str, dict[str, str]] = field(default_factory=dict)
    parent_class: dict[str, str | None] = field(default_factory=dict)

    def run(self) -> dict[Path, bytes]:
        """Return the content of every file of the mirrored model, by path.

        Raises:
            MirrorError: If the file holds what is not known here, or what no mirrored hand can have.
        """
        text = self.file.read_text(encoding="utf-8")
        try:
            ET.fromstring(text)
        except ET.ParseError as error:
            raise MirrorError(f"{self.file}: {error}") from error
        if re.search(r"<!(DOCTYPE|\[CDATA\[)", text):
            raise MirrorError(f"{self.file}: document types and CDATA sections are not supported")
        parts = pieces(text, self.mirror)
        elements = [part for part in parts if isinstance(part, Element)]
        self._note(elements)
        for element in elements:
            self._reflect(element)
        header = "<!-- " + "\n     ".join(self._header()) + " -->\n"
        target = self.file.with_name(self.mirror.file(self.file.name))
        self.outputs[target] = (header + "".join(map(str, parts))).encode()
        return self.outputs

    def _header(self) -> list[str]:
        side, axis = self.mirror.source, "xyz"[self.mirror.axis]
        return [
            f"Generated by robots/mirror.py from {self.file.name}: the {side} hand mirrored along {axis}.",
            "Change that file and run the script again. The same joint values put both hands into mirrored poses.",
        ]

    def _note(self, elements: list[Element]) -> None:
        """Note what elements refer to, before any is changed."""
        folder = ""
        for element in elements:
            if element.tag == "compiler":
                self.euler = element.attributes.get("eulerseq", self.euler)
                folder = element.attributes.get("meshdir", element.attributes.get("assetdir", folder))
            elif element.tag == "default" and element.parent is not None:
                outer = _class(element.parent) if element.parent.tag == "default" else None
                self.parent_class[_class(element)] = outer
            elif element.key == "joint" and element.parent is not None and element.parent.tag == "default":
                self.joint_defaults.setdefault(_class(element), {}).update(element.attributes)
        self.mesh_folder = self.file.parent / folder

    def _reflect(self, element: Element) -> None:
        """Mirror all attributes of an element in place."""
        known = ATTRIBUTES.get(element.key)
        if known is None:
            raise self._error(element, f"<{element.tag}> is not known to robots/mirror.py: it may hold geometry")
        names = dict(element.attributes)
        if element.key == "joint":
            self._reflect_axis(element)
        for name, text in names.items():
            if known != ANYTHING and name not in known.split():
                what = f'the attribute "{name}" of <{element.tag}> is not known to robots/mirror.py: it may hold geometry'
                raise self._error(element, what)
            if name != "axis":
                element.attributes[name] = self._value(element, name, text, known)
        if element.key == "camera" and not {"quat", "xyaxes"} & set(names) and self.mirror.axis != 0:
            element.attributes["quat"] = self._camera_quat(element, "1 0 0 0")

    def _value(self, element: Element, name: str, text: str, known: str) -> str:
        """Return the mirrored text of an attribute."""
        if element.tag == "mesh" and name in ("file", "scale", "vertex", "face"):
            return self._mesh_value(element, name, text)
        if name in NAMES.split():
            return self.mirror.renamed(text)
        if known == ANYTHING:
            return text
        if element.key == "camera" and name == "quat":
            return self._camera_quat(element, text)
        if element.key == "camera" and name == "xyaxes":
            return self._signed(element, name, text, (*self.mirror.axial, *self.mirror.polar))
        if name == "type" and element.tag == "geom" and text in ("plane", "hfield", "sdf"):
            raise self._error(element, f"a geom of type {text} cannot be mirrored")
        if name == "euler":
            return self._signed(element, name, text, tuple(self.mirror.axial["xyz".index(i)] for i in self.euler.lower()))
        if name not in SIGNS:
            return text
        text = self._signed(element, name, text, SIGNS[name](self.mirror))
        if name == "fromto" and self.mirror.axis == 2:  # the frame's z axis runs from one end to the other
            numbers = text.split()
            text = " ".join(numbers[3:] + numbers[:3])
        return text

    def _signed(self, element: Element, name: str, text: str, signs: Signs) -> str:
        if len(text.split()) != len(signs):
            raise self._error(element, f'"{name}" has {len(text.split())} numbers, expected {len(signs)}')
        return signed(text, signs)

    def _camera_quat(self, element: Element, text: str) -> str:
        """Return the orientation of a camera that sees the mirror image.

        A camera looks along −z, so its own frame is reflected left to right, whatever the axis: M R diag(−1, 1, 1), which is
        M R M, turned by half a turn about the third axis.
        """
        w, x, y, z = self._signed(element, "quat", text, (1, *self.mirror.axial)).split()
        turned = {0: (w, x, y, z), 1: (flipped(z), y, flipped(x), w), 2: (flipped(y), flipped(z), w, x)}
        return " ".join(turned[self.mirror.axis])

    # Joints: the axis of a hinge is a pseudovector, that of a slide is a vector, and which it is may come from a class.

    def _reflect_axis(self, element: Element) -> None:
        """Mirror a joint's axis, also where it is inherited and means something else in the class that it comes from."""
        is_default = element.parent is not None and element.parent.tag == "default"
        own_class = _class(element)
        kind = element.attributes.get("type") or self._inherited(own_class, "type")[0] or "hinge"
        if kind in ("ball", "free"):
            raise self._error(element, f"a {kind} joint is not supported: the same value would not give the mirrored pose")
        axis = element.attributes.get("axis")
        inherited, defining = self._inherited(own_class, "axis")
        wanted = self._axis(element, axis or inherited or "0 0 1", kind)
        given = "0 0 1"
        if inherited is not None and defining is not None:
            given = self._axis(element, inherited, self._inherited(defining, "type")[0] or "hinge")
        if axis is not None or (not is_default and [*map(float, wanted.split())] != [*map(float, given.split())]):
            element.attributes["axis"] = wanted

    def _axis(self, element: Element, text: str, kind: str) -> str:
        return self._signed(element, "axis", text, self.mirror.polar if kind == "slide" else self.mirror.axial)

    def _inherited(self, name: str | None, attribute: str) -> tuple[str | None, str | None]:
        """Return what joints of a class inherit, and the class that says so."""
        while name is not None:
            if attribute in (given := self.joint_defaults.get(name, {})):
                return given[attribute], name
            name = self.parent_class.get(name)
        return None, None

    # Meshes.

    def _mesh_value(self, element: Element, name: str, text: str) -> str:
        if name == "scale":
            if any(float(number) < 0 for number in text.split()):
                raise self._error(element, "a mesh with a negative scale is mirrored already: write the mirrored file instead")
            return text
        numbers = text.split()
        if name == "vertex":
            return self._signed(element, name, text, self.mirror.polar * (len(numbers) // 3))
        if name == "face":
            return "  ".join(f"{numbers[i]} {numbers[i + 2]} {numbers[i + 1]}" for i in range(0, len(numbers), 3))
        return self._mesh_file(element, text)

    def _mesh_file(self, element: Element, name: str) -> str:
        """Return the file of the mirrored mesh: its own where the mesh is symmetric, else one that is written."""
        source = self.mesh_folder / name
        try:
            content = source.read_bytes()
            new = mirrored_stl(content, self.mirror)
        except (OSError, MirrorError) as error:
            raise self._error(element, f"{source}: {getattr(error, 'strerror', None) or error}") from error
        target = name
        if not same_triangles(content, new):
            target = self.mirror.mesh_file(name)
            self.outputs[self.mesh_folder / target] = new
        implied, wanted = PurePosixPath(target).stem, self.mirror.renamed(PurePosixPath(name).stem)
        if "name" not in element.attributes and implied != wanted:
            element.attributes["name"] = wanted
        return target

    def _error(self, element: Element, what: str) -> MirrorError:
        return MirrorError(f"{self.file}:{element.line}: {what}")


def _class(element: Element) -> str:
    """Return the default class of a default, of an element in it, or of an element in the tree of bodies."""
    if element.tag != "default" and (name := element.attributes.get("class")):
        return name
    outer = element if element.tag == "default" else element.parent
    while outer is not None:
        if outer.tag == "default":
            return outer.attributes.get("class", "main")
        if name := outer.attributes.get("childclass"):
            return name
        outer = outer.parent
    return "main"
