"""Mitsuba XML to a tree of plugins: files, includes, parameters, references and the names of old dialects.

This module knows the grammar of the format and nothing of rendering; `wavefront.scene.mitsuba` gives the plugins their
meaning. The grammar is that of Mitsuba 3.9, whose upgrade rules for files of version 0.x are applied (snake_case names,
`diffuse_reflectance` of a diffuse BSDF, `uscale` and its kin to `to_uv`); `srgb` and `lookAt` of Mitsuba 0.5 and 0.6
are also understood.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene import transforms
from wavefront.scene.mitsuba_values import STEP_TAGS, Element, nearest, to_matrix, to_number, to_xyz
from wavefront.scene.transforms import rows as rows  # for the importers of what is in a document

OBJECT_TAGS = (
    "scene", "bsdf", "emitter", "film", "integrator", "medium", "phase", "rfilter", "sampler", "sensor", "shape",
    "texture", "volume", "subsurface",
)  # fmt: skip
PROPERTY_TAGS = ("boolean", "float", "integer", "string", "point", "vector", "rgb", "srgb", "spectrum", "transform")
_OTHER_TAGS = ("ref", "include", "alias", "default", "path")
_OLD_TAGS = {"luminaire": "emitter", "camera": "sensor", "blackbody": "rgb"}
_MAX_INCLUDES = 15


def snake_case(name: str) -> str:
    """``toWorld`` to ``to_world``, ``intIOR`` to ``int_ior``: the rule of Mitsuba 3 for files of version 0.x."""
    return re.sub(r"(?<=[a-z])[A-Z]+", lambda capitals: "_" + capitals[0].lower(), name)


# --- XML to elements -------------------------------------------------------------------------------------------


def parse_xml(path: Path) -> Element:
    """The root element of an XML file. Raises SceneError: missing, unreadable, or bad XML (with line and column)."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise SceneError("file not found", path) from None
    except (OSError, ValueError) as error:
        raise SceneError(f"cannot be read: {getattr(error, 'strerror', None) or error}", path) from None
    parser = expat.ParserCreate()
    stack: list[Element] = []
    roots: list[Element] = []

    def start(tag, attributes):
        element = Element(tag.lower(), attributes, path, parser.CurrentLineNumber)
        (stack[-1].children if stack else roots).append(element)
        if len(stack) > 100:
            raise element.error("elements are nested too deeply")
        stack.append(element)

    def end(_tag):
        stack.pop()

    def text(characters):
        if characters.strip() and stack:
            raise stack[-1].error(f"unexpected text {' '.join(characters.split())[:40]!r} in <{stack[-1].tag}>")

    def entity(name, *_):
        # entities could grow without bound, and no scene needs them
        raise SceneError(f"entity {name!r}: entities are not supported", path, f"line {parser.CurrentLineNumber}")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, text
    parser.EntityDeclHandler = entity
    parser.buffer_text = True
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        where = f"line {error.lineno}, column {error.offset + 1}"
        raise SceneError(f"bad XML: {expat.ErrorString(error.code)}", path, where) from None
    except (ValueError, LookupError) as error:  # an encoding that Python does not have
        raise SceneError(f"bad XML: {error}", path) from None
    return roots[0]


# --- elements to plugins ---------------------------------------------------------------------------------------


@dataclass(eq=False, repr=False)
class Plugin:
    """A Mitsuba object: its tag (``bsdf``), type (``diffuse``), properties and children. Getters note what was asked
    for, so that `finish` can report what nobody wanted."""

    element: Element
    tag: str
    type: str
    id: str
    document: Document
    properties: dict[str, Element] = field(default_factory=dict)
    children: list[tuple[str, Plugin | Element]] = field(default_factory=list)
    known: set[str] = field(default_factory=set)

    def __post_init__(self):
        self.error, self.where = self.element.error, self.element.where

    def label(self) -> str:
        """Such as ``bsdf 'diffuse'``."""
        return f"{self.tag} {self.type!r}"

    def has(self, name: str) -> bool:
        """Whether there is a property or a named child `name`."""
        self.known.add(name)
        return name in self.properties or any(child_name == name for child_name, _ in self.children)

    def ignore(self, *names: str) -> None:
        """Accepts properties that do not change the image."""
        self.known.update(names)

    def get(self, name: str) -> Element | None:
        """The element of a property, or None."""
        self.known.add(name)
        return self.properties.get(name)

    def child(self, name: str) -> Plugin | None:
        """The object given under `name`, references followed, or None."""
        self.known.add(name)
        for child_name, child in self.children:
            if child_name == name:
                return self.document.resolve(child)
        return None

    def objects(self, tag: str) -> list[Plugin]:
        """Unnamed children of a kind, references followed."""
        self.known.add(f"<{tag}>")
        return [child for name, child in self.resolved() if not name and child.tag == tag]

    def resolved(self) -> Iterator[tuple[str, Plugin]]:
        """All children as (name, plugin), references followed. The name of a bsdf, an emitter, a film and the like says
        nothing and is left out; that of a texture or a medium says what it is for."""
        for name, child in self.children:
            plugin = self.document.resolve(child)
            keeps_name = plugin.tag in ("texture", "medium", "volume", "phase") or name in ("interior", "exterior")
            yield (name if keeps_name else ""), plugin

    def number(self, name: str, default: float | None = None) -> float | None:
        """A <float> or <integer>."""
        element = self.get(name)
        if element is None:
            return default
        return to_number(element, self._typed(element, "float", "integer"))

    def integer(self, name: str, default: int) -> int:
        """An <integer>."""
        element = self.get(name)
        if element is None:
            return default
        text = self._typed(element, "integer")
        try:
            return int(text)
        except ValueError:
            raise element.error(f"{text!r} is not an integer") from None

    def boolean(self, name: str, default: bool = False) -> bool:
        """A <boolean>."""
        element = self.get(name)
        if element is None:
            return default
        text = self._typed(element, "boolean").strip().lower()
        if text not in ("true", "false"):
            raise element.error(f"{text!r} is not a boolean; allowed: true, false")
        return text == "true"

    def string(self, name: str, default: str, choices: tuple[str, ...] = ()) -> str:
        """A <string>, one of `choices` where given."""
        element = self.get(name)
        if element is None:
            return default
        text = self._typed(element, "string")
        if choices and text not in choices:
            raise element.error(f"{name} {text!r} is not supported; {nearest(text, choices)}")
        return text

    def vector(self, name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
        """A <point> or <vector>."""
        element = self.get(name)
        if element is None:
            return default
        if element.tag not in ("point", "vector"):
            raise element.error(f"{name!r} must be a point, not <{element.tag}>")
        element.check_attributes("name", "x", "y", "z", "value")
        return to_xyz(element, 0.0)

    def transform(self, name: str) -> np.ndarray | None:
        """The (4, 4) matrix of a <transform>, the first step applied first, or None."""
        element = self.get(name)
        if element is None:
            return None
        if element.tag != "transform":
            raise element.error(f"{name!r} must be a <transform>, not <{element.tag}>")
        return to_matrix(element)

    def finish(self, *children: str) -> None:
        """Raises SceneError for a property that nobody asked for, or a child whose kind is not in `children`."""
        names = {name for name in self.known if not name.startswith("<")}
        for name, element in self.properties.items():
            if name not in names:
                raise element.error(f"{self.label()} has no property {name!r}; {nearest(name, names)}")
        for name, child in self.resolved():
            if name and name not in names:
                raise child.error(f"{self.label()} has no property {name!r} ({child.tag}); {nearest(name, names)}")
            if not name and child.tag not in children:
                allowed = ", ".join(children) or "none"
                raise child.error(f"{self.label()} cannot hold a {child.tag}; allowed: {allowed}")

    def _typed(self, element, *tags):
        if element.tag not in tags:
            raise element.error(f"{element.attributes.get('name')!r} must be <{tags[0]}>, not <{element.tag}>")
        element.check_attributes("name", "value")
        return element.attribute("value")


@dataclass(eq=False, repr=False)
class Document:
    """A scene with all that it includes.

    Attributes:
        path: The main file.
        version: Its dialect, such as (0, 6, 0).
        scene: The root plugin.
        ids: Plugins by id and by alias.
        folders: Where files are looked for, after the folder of the XML file that names them.
    """

    path: Path
    version: tuple[int, ...] = ()
    scene: Plugin = None
    ids: dict[str, Plugin] = field(default_factory=dict)
    folders: list[Path] = field(default_factory=list)

    def resolve(self, child: Plugin | Element) -> Plugin:
        """The plugin itself, or the one that a <ref> names."""
        if isinstance(child, Plugin):
            return child
        name = child.attribute("id")
        if name not in self.ids:
            close = difflib.get_close_matches(name, self.ids, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise child.error(f"nothing in the scene has the id {name!r}{hint}")
        return self.ids[name]

    def find(self, name: str, element: Element) -> Path:
        """Absolute path of a file that an element names. Raises SceneError where there is none."""
        for text in (name, name.replace("\\", "/")):
            for folder in (element.file.parent, *self.folders, self.path.parent):
                if "\0" not in text and (folder / text).is_file():
                    return Path(os.path.abspath(folder / text))
        raise element.error(f"file not found: {name!r}")


def read(path: Path, parameters: Mapping[str, object]) -> Document:
    """Reads a scene file and what it includes.

    Raises:
        SceneError: Bad XML, a missing file or include, an undefined parameter, an unknown element, an id used twice.
    """
    builder = _Builder(Document(path), {name: str(value) for name, value in parameters.items()})
    root = parse_xml(path)
    if root.tag != "scene":
        raise root.error(f"the root element must be <scene>, not <{root.tag}>")
    document = builder.document
    document.version = builder.version = _version(root)
    document.scene = Plugin(root, "scene", "scene", "", document)
    builder.depth = 0
    for element in root.children:
        builder.add(element, document.scene)
    for name in parameters:
        if name not in builder.used:
            raise SceneError(f"the scene has no parameter ${name}; {nearest(name, builder.used)}", path)
    _check_references(document)
    return document


def world_matrix(plugin: Plugin) -> np.ndarray:
    """The (4, 4) to_world of a plugin. Raises SceneError with file and line: projective or not invertible."""
    matrix = plugin.transform("to_world")
    if matrix is None:
        return np.eye(4)
    element = plugin.get("to_world")
    try:
        transforms.check_affine(matrix)
        transforms.check_invertible(matrix)
    except SceneError as error:
        raise element.error(error.message) from None
    return matrix


def _check_references(document):
    """Resolves every <ref>, so that none is missing, and refuses objects that contain themselves."""
    done = set()

    def visit(plugin, above):
        if id(plugin) in above:
            raise plugin.error(f"{plugin.label()} {plugin.id!r} contains itself")
        if id(plugin) in done:
            return
        for _, child in plugin.resolved():
            visit(child, {*above, id(plugin)})
        done.add(id(plugin))

    visit(document.scene, set())


def _version(root):
    text = root.attribute("version")
    if not re.fullmatch(r"\d+(\.\d+)*", text.strip()):
        raise root.error(f"version {text!r} is not a version such as 3.0.0")
    return tuple(int(part) for part in text.split("."))


@dataclass
class _Builder:
    document: Document
    values: dict[str, str]
    used: set[str] = field(default_factory=set)
    version: tuple[int, ...] = ()
    depth: int = 0

    def add(self, element: Element, parent: Plugin) -> None:
        """Adds what an element says to `parent`, in document order: parameters are known from their <default> on."""
        self._substitute(element)
        tag = element.tag
        name = element.attributes.get("name", "")
        if tag in OBJECT_TAGS or (tag == "spectrum" and "type" in element.attributes):
            self._add_object(element, parent, self._property_name(name, parent))
        elif tag in PROPERTY_TAGS:
            if not name:
                raise element.error(f"<{tag}> needs the attribute 'name'")
            self._add_property(element, parent, self._property_name(name, parent))
        elif tag == "ref":
            element.check_attributes("id", "name")
            element.attribute("id")
            self._add_child(element, parent, self._property_name(name, parent), element)
        elif tag == "include":
            self._include(element, parent)
        elif tag == "alias":
            element.check_attributes("id", "as")
            self._register(element.attribute("as"), self.document.resolve(element), element)
        elif tag == "default":
            element.check_attributes("name", "value")
            self.used.add(element.attribute("name"))
            self.values.setdefault(element.attribute("name"), element.attribute("value"))
        elif tag == "path":
            element.check_attributes("value")
            self.document.folders.append(element.file.parent / element.attribute("value"))
        elif tag in STEP_TAGS:
            raise element.error(f"<{tag}> belongs inside a <transform>")
        else:
            known = (*OBJECT_TAGS, *PROPERTY_TAGS, *_OTHER_TAGS)
            hint = f"use <{_OLD_TAGS[tag]}>" if tag in _OLD_TAGS else nearest(tag, known)
            raise element.error(f"element <{tag}> is not supported; {hint}")

    def _property_name(self, name, parent):
        name = snake_case(name)
        return "reflectance" if name == "diffuse_reflectance" and parent.type == "diffuse" else name

    def _add_object(self, element, parent, name):
        element.check_attributes("type", "id", "name", *(["version"] if element.tag == "scene" else []))
        tag = "texture" if element.tag == "spectrum" else element.tag
        plugin = Plugin(element, tag, element.attribute("type"), element.attributes.get("id", ""), self.document)
        if plugin.id:
            self._register(plugin.id, plugin, element)
        self._add_child(plugin, parent, name, element)
        for child in element.children:
            self.add(child, plugin)
        self._upgrade_uv(plugin)

    def _add_child(self, child, parent, name, element):
        if name:
            self._check_new(name, parent, element)
        parent.children.append((name, child))

    def _check_new(self, name, parent, element):
        if name in parent.properties or any(name == other for other, _ in parent.children):
            raise element.error(f"property {name!r} of {parent.label()} is given twice")

    def _add_property(self, element, parent, name):
        self._check_new(name, parent, element)
        if element.tag == "transform":
            element.check_attributes("name")
            for step in element.children:
                self._substitute(step)
        elif element.children:
            raise element.children[0].error(f"<{element.children[0].tag}> cannot stand inside <{element.tag}>")
        parent.properties[name] = element

    def _upgrade_uv(self, plugin):
        """uscale, vscale, uoffset, voffset of Mitsuba 0.x as a to_uv: the offset is added first, as Mitsuba 3 does."""
        names = ("uoffset", "voffset", "uscale", "vscale")
        if plugin.tag != "texture" or not any(name in plugin.properties for name in names):
            return
        values = [plugin.number(name, default) for name, default in zip(names, (0.0, 0.0, 1.0, 1.0), strict=True)]
        first = next(plugin.properties[name] for name in names if name in plugin.properties)
        if "to_uv" in plugin.properties:
            raise first.error("to_uv excludes uoffset, voffset, uscale and vscale")
        for name in names:
            plugin.properties.pop(name, None)
        steps = [
            Element("translate", {"x": repr(values[0]), "y": repr(values[1])}, first.file, first.line),
            Element("scale", {"x": repr(values[2]), "y": repr(values[3])}, first.file, first.line),
        ]
        plugin.properties["to_uv"] = Element("transform", {"name": "to_uv"}, first.file, first.line, steps)

    def _register(self, name, plugin, element):
        if name in self.document.ids:
            raise element.error(f"the id {name!r} is used twice; first in line {self.document.ids[name].element.line}")
        self.document.ids[name] = plugin

    def _include(self, element, parent):
        element.check_attributes("filename", "name")
        if self.depth >= _MAX_INCLUDES:
            raise element.error(f"more than {_MAX_INCLUDES} nested includes; does a file include itself?")
        root = parse_xml(self.document.find(element.attribute("filename"), element))
        outer = self.version
        self.version = _version(root)
        self.depth += 1
        if root.tag == "scene":
            for child in root.children:
                self.add(child, parent)
        else:
            root.attributes.pop("version")
            self.add(root, parent)
        self.version = outer
        self.depth -= 1

    def _substitute(self, element):
        """Replaces $name in attributes, longest name first as Mitsuba does, and \\$ by a plain dollar sign."""
        for key, text in element.attributes.items():
            if "$" not in text:
                continue
            names = "|".join(map(re.escape, sorted(self.values, key=len, reverse=True)))
            pattern = rf"\\\$|\$({names})" if names else r"\\\$|\$(?!)()"
            parts = re.split(pattern, text)
            for rest in parts[::2]:
                if "$" in rest:
                    name = re.search(r"\$(\w*)", rest)[1]
                    raise element.error(f"parameter ${name} is not defined; {nearest(name, self.values)}")
            self.used.update(name for name in parts[1::2] if name)
            element.attributes[key] = re.sub(pattern, lambda m: self.values[m[1]] if m[1] else "$", text)
