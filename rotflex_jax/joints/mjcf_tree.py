"""Bodies and joints of an MJCF file at rest, read safely and with classes of defaults resolved."""

import dataclasses
import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Any
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.text.files import path_of
from rotflex_jax.text.numbers import one_line

LARGEST_FILE = 10_000_000
"""Largest size of a file that is read as MJCF [bytes]."""

DEEPEST = 200
"""Largest depth of nested elements in a file."""

# Elements that change the file or its bodies before anything is read.
_UNREAD = ("include", "attach", "replicate", "frame", "composite", "flexcomp", "model")

LARGEST_NUMBER = 1e12
"""Limit of numbers; larger ones are no masses, sizes or torques of a machine."""

SMALLEST = 1e-9
"""Smallest size of a shape [m]."""

WATER = 1000.0
"""Density of a shape without a given density [kg/m^3]."""


@dataclasses.dataclass(frozen=True)
class FileJoint:
    """A joint at rest, in the frame of the world.

    Attributes:
        name: Name of the joint.
        body: Number of its body.
        slides: Whether the joint slides; otherwise it turns.
        axis: Unit vector of the axis.
        anchor: A point on the axis [m].
        attributes: Attributes of the joint, including those of its class.
    """

    name: str
    body: int
    slides: bool
    axis: Float[np.ndarray, "3"]
    anchor: Float[np.ndarray, "3"]
    attributes: dict[str, str]


@dataclasses.dataclass
class FileBody:
    """A body at rest, in the frame of the world.

    Attributes:
        name: Name of the body.
        parent: Number of its parent; -1 for the world.
        mass: Mass [kg].
        centre: Centre of mass [m].
        inertia: Inertia about the centre of mass [kg m^2].
    """

    name: str
    parent: int
    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


class FileModel:
    """An MJCF file.

    Args:
        path: Path of the file.

    Raises:
        InputError: The file cannot be read, is no MJCF, or has elements that this reader does not support.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = str(path)
        self.root = _parsed(path)
        if self.root.tag != "mujoco":
            raise self.error(
                f"begins with <{one_line(self.root.tag)[:40]}>", "an MJCF file begins with <mujoco>"
            )
        for element in self.root.iter():
            if element.tag in _UNREAD:
                raise self.error(
                    f"has the element <{element.tag}>",
                    "load it in MuJoCo and save it again, which resolves these",
                )
        self.settings: dict[str, str] = {}
        for element in self.root.findall("compiler"):
            self.settings |= element.attrib
        for name in (
            "settotalmass",
            "inertiagrouprange",
            "coordinate",
            "boundmass",
            "boundinertia",
            "balanceinertia",
        ):
            if name in self.settings:
                raise self.error(f"has the setting {name} of the compiler", "write masses and inertias out")
        self.options: dict[str, str] = {}
        self.flags: dict[str, str] = {}
        for element in self.root.findall("option"):
            self.options |= element.attrib
            for flag in element.findall("flag"):
                self.flags |= flag.attrib
        self.degrees = self.settings.get("angle", "degree") != "radian"
        self.classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for element in self.root.findall("default"):
            self._read_classes(element, element.get("class", "main"), {})
        self.bodies: list[FileBody] = []
        self.joints: list[FileJoint] = []
        for world in self.root.findall("worldbody"):
            for element in world.findall("body"):
                self._read_body(element, -1, np.zeros(3), np.eye(3), world.get("childclass"))

    def error(self, what: str, instead: str) -> InputError:
        """An error with a sentence on this file."""
        return InputError(f"{one_line(self.path)} {what}, which cannot be read; {instead}.")

    # -- attributes --------------------------------------------------------------------------------

    def _read_classes(self, element: ET.Element, name: str, above: dict[str, dict[str, str]]) -> None:
        own = {tag: dict(attributes) for tag, attributes in above.items()}
        for child in element:
            if child.tag != "default":
                own[child.tag] = own.get(child.tag, {}) | child.attrib
        self.classes[name] = own
        for child in element.findall("default"):
            self._read_classes(child, child.get("class", ""), own)

    def attributes_of(self, element: ET.Element, childclass: str | None = None, *also: str) -> dict[str, str]:
        """Attributes of an element with those of its class; `also` names tags whose defaults count."""
        name = element.get("class", childclass or "main")
        if name not in self.classes:
            raise self.error(f"names the class {one_line(name)!r}", "define it under <default>")
        known = self.classes[name]
        found: dict[str, str] = {}
        for tag in (*also, element.tag):
            found |= known.get(tag, {})
        return found | element.attrib

    def numbers(self, attributes: dict[str, str], name: str, count: int | None, default: Any = None) -> Any:
        """Numbers of an attribute; the default if the attribute is missing.

        Raises:
            InputError: The attribute is not `count` finite numbers.
        """
        if name not in attributes:
            return default
        try:
            found = np.array([float(x) for x in attributes[name].split()])
        except ValueError:
            found = np.array([math.nan])
        if (
            not len(found)
            or not (np.abs(found) < LARGEST_NUMBER).all()
            or (count is not None and len(found) != count)
        ):
            need = "numbers" if count is None else f"{count} finite number{'s' * (count > 1)}"
            raise self.error(f'has {name}="{one_line(attributes[name])[:40]}"', f"write {need}")
        return found

    def number(self, attributes: dict[str, str], name: str, default: float = 0.0) -> float:
        """An attribute that is one number."""
        found = self.numbers(attributes, name, 1)
        return default if found is None else float(found[0])

    def _turn(self, attributes: dict[str, str]) -> np.ndarray:
        """Rotation matrix of the orientation of an element."""
        unit = math.pi / 180 if self.degrees else 1.0
        if "quat" in attributes:
            w, *xyz = self.numbers(attributes, "quat", 4)
            return _turned(np.array(xyz), 2 * math.atan2(float(np.linalg.norm(xyz)), w))
        if "axisangle" in attributes:
            *axis, angle = self.numbers(attributes, "axisangle", 4)
            return _turned(np.array(axis), angle * unit)
        if "euler" in attributes:
            matrix = np.eye(3)
            sequence = self.settings.get("eulerseq", "xyz")
            if len(sequence) != 3 or set(sequence.lower()) - set("xyz"):
                raise self.error(f'has eulerseq="{one_line(sequence)[:20]}"', "write three of x, y, z")
            for letter, angle in zip(sequence, self.numbers(attributes, "euler", 3), strict=True):
                one = _turned(np.eye(3)["xyz".index(letter.lower())], angle * unit)
                # Lower-case letters are axes that turn with the body.
                matrix = matrix @ one if letter.islower() else one @ matrix
            return matrix
        if "xyaxes" in attributes:
            six = self.numbers(attributes, "xyaxes", 6)
            x = _unit(six[:3])
            y = _unit(six[3:] - (six[3:] @ x) * x)
            return np.column_stack([x, y, np.cross(x, y)])
        if "zaxis" in attributes:
            return _turn_to(self.numbers(attributes, "zaxis", 3))
        return np.eye(3)

    # -- bodies ------------------------------------------------------------------------------------

    def _read_body(
        self, element: ET.Element, parent: int, at: np.ndarray, turn: np.ndarray, childclass: str | None
    ) -> None:
        attributes, number = dict(element.attrib), len(self.bodies)
        childclass = attributes.get("childclass", childclass)
        if self.number(attributes, "gravcomp"):
            raise self.error("has gravcomp on a body", "leave it out")
        at = at + turn @ (self.numbers(attributes, "pos", 3, np.zeros(3)))
        turn = turn @ self._turn(attributes)
        mass, centre, inertia = self._mass(element, childclass)
        inertia = turn @ inertia @ turn.T
        name = attributes.get("name", f"body {number}")
        self.bodies.append(FileBody(name, parent, mass, at + turn @ (centre), inertia))
        for joint in element.findall("joint"):
            own = self.attributes_of(joint, childclass)
            kind = own.get("type", "hinge")
            if kind not in ("hinge", "slide"):
                continue  # has several degrees of freedom, so it cannot be chosen
            axis = self.numbers(own, "axis", 3, np.array([0.0, 0.0, 1.0]))
            if not np.linalg.norm(axis) > SMALLEST:
                raise self.error(
                    f'has a joint with axis="{one_line(own["axis"])[:40]}"',
                    "write a direction that is not zero",
                )
            axis = _unit(turn @ axis)
            anchor = at + turn @ (self.numbers(own, "pos", 3, np.zeros(3)))
            label = own.get("name", f"joint {len(self.joints)}")
            self.joints.append(FileJoint(label, number, kind == "slide", axis, anchor, own))
        for child in element.findall("body"):
            self._read_body(child, number, at, turn, childclass)

    def _mass(self, body: ET.Element, childclass: str | None) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, centre of mass and inertia of a body, in its frame."""
        inertial, mode = body.find("inertial"), self.settings.get("inertiafromgeom", "auto")
        if inertial is not None and mode != "true":
            attributes = dict(inertial.attrib)
            mass = self.number(attributes, "mass", math.nan)
            if not mass >= 0:
                raise self.error("has an <inertial> without a mass", 'write mass="..."')
            matrix = self._turn(attributes)
            inertia = np.diag(self.numbers(attributes, "diaginertia", 3, np.zeros(3)))
            if "fullinertia" in attributes:
                xx, yy, zz, xy, xz, yz = self.numbers(attributes, "fullinertia", 6)
                inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            return mass, self.numbers(attributes, "pos", 3, np.zeros(3)), matrix @ inertia @ matrix.T
        parts = [] if mode == "false" else list(self._shapes(body, childclass))
        mass = sum(m for m, _, _ in parts)
        if not mass:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        centre = sum((m * c for m, c, _ in parts), np.zeros(3)) / mass
        inertia = np.zeros((3, 3))
        for m, c, own in parts:
            r = c - centre
            inertia += own + m * (r @ r * np.eye(3) - np.outer(r, r))
        return mass, centre, inertia

    def _shapes(
        self, body: ET.Element, childclass: str | None
    ) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        for element in body.findall("geom"):
            attributes = self.attributes_of(element, childclass)
            density = self.number(attributes, "density", WATER)
            if attributes.get("mass") is not None and not self.number(attributes, "mass"):
                continue
            if "mass" not in attributes and not density:
                continue
            kind, size = attributes.get("type", "sphere"), self.numbers(attributes, "size", None, np.zeros(1))
            if attributes.get("shellinertia") == "true":
                raise self.error(
                    "has a shape of which only the shell has mass", "give its body an <inertial>"
                )
            place, turn = self.numbers(attributes, "pos", 3, np.zeros(3)), self._turn(attributes)
            if "fromto" in attributes:
                ends = self.numbers(attributes, "fromto", 6)
                place, turn = (ends[:3] + ends[3:]) / 2, _turn_to(ends[3:] - ends[:3])
                half = float(np.linalg.norm(ends[3:] - ends[:3])) / 2
                size = (
                    np.array([size[0], size[0], half])
                    if kind in ("box", "ellipsoid")
                    else np.array([size[0], half])
                )
            volume, per_mass = self._solid(kind, size)
            mass = self.number(attributes, "mass", density * volume)
            yield mass, place, turn @ np.diag(mass * per_mass) @ turn.T

    def _solid(self, kind: str, size: np.ndarray) -> tuple[float, np.ndarray]:
        """Volume of a shape, and its moments of inertia per mass."""
        need = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
        if kind not in need or len(size) < need[kind] or not (size[: need[kind]] > SMALLEST).all():
            what = f"has a shape of type {one_line(kind)!r} that counts towards a mass"
            raise self.error(what, "give its body an <inertial>, or the shape sizes above zero")
        if kind == "sphere":
            return 4 / 3 * math.pi * size[0] ** 3, np.full(3, 0.4 * size[0] ** 2)
        a = size[:3] ** 2
        if kind in ("box", "ellipsoid"):
            share, volume = (1 / 3, 8.0) if kind == "box" else (1 / 5, 4 / 3 * math.pi)
            return volume * float(np.prod(size[:3])), share * np.array(
                [a[1] + a[2], a[0] + a[2], a[0] + a[1]]
            )
        r, half = float(size[0]), float(size[1])
        tube, ball = 2 * math.pi * r**2 * half, 4 / 3 * math.pi * r**3
        if kind == "cylinder":
            across = r**2 / 4 + half**2 / 3
            return tube, np.array([across, across, r**2 / 2])
        across = tube * (r**2 / 4 + half**2 / 3) + ball * (0.4 * r**2 + half**2 + 0.75 * half * r)
        along = tube * r**2 / 2 + ball * 0.4 * r**2
        return tube + ball, np.array([across, across, along]) / (tube + ball)

    def below(self, body: int) -> list[int]:
        """A body and all its descendants."""
        found = {body}
        for k in range(body + 1, len(self.bodies)):
            if self.bodies[k].parent in found:
                found.add(k)
        return sorted(found)


def _parsed(path: str | os.PathLike[str]) -> ET.Element:
    """The tree of an XML file that declares no types and no entities."""
    place = path_of(path)
    shown = one_line(str(place))
    try:
        size = place.stat().st_size
        data = place.read_bytes() if size <= LARGEST_FILE else b""
    except (OSError, ValueError) as error:  # a file name cannot have a zero byte
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{shown} cannot be read ({reason}); give the path of an MJCF file.") from error
    if size > LARGEST_FILE:
        raise InputError(
            f"{shown} has {size} bytes, but an MJCF file has at most {LARGEST_FILE}; give one of these."
        )
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    depth = 0

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise InputError(
                f"{shown} has more than {DEEPEST} elements inside one another; give an MJCF file."
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*declared: Any) -> None:
        raise InputError(
            f"{shown} declares a document type, which may hide entities; take the declaration out."
        )

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
        return builder.close()
    except InputError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two: an unknown encoding
        raise InputError(f"{shown} is no XML ({error}); give the path of an MJCF file.") from error


def _unit(vector: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    return vector / length if length else np.array([0.0, 0.0, 1.0])


def _turned(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix for an axis and an angle (Rodrigues)."""
    x, y, z = _unit(axis)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * across @ across


def _turn_to(direction: np.ndarray) -> np.ndarray:
    """Rotation matrix that turns the z axis into a direction by the smallest angle."""
    z = _unit(direction)
    axis = np.cross([0.0, 0.0, 1.0], z)
    sine = float(np.linalg.norm(axis))
    return _turned(axis if sine > 1e-12 else np.array([1.0, 0.0, 0.0]), math.atan2(sine, float(z[2])))
