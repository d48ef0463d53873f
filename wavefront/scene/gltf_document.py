"""glTF 2.0 files: the JSON as typed records, the buffers and images as bytes.

Only what the renderer reads is declared here; other keys are let pass, as the standard wants. Errors name the JSON path
in the file, such as ``materials[2].pbrMetallicRoughness.baseColorTexture.index``.
"""

from __future__ import annotations

import base64
import binascii
import functools
import os
import re
import struct
import urllib.parse
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from wavefront.errors import SceneError
from wavefront.scene import json_format
from wavefront.scene.description import Fraction, NonNegative, Positive, Vec2, Vec3, Vec4
from wavefront.scene.explain import explain
from wavefront.scene.lookup import shown

SUPPORTED_EXTENSIONS = frozenset(
    (
        "KHR_lights_punctual",
        "KHR_materials_anisotropy",
        "KHR_materials_clearcoat",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_sheen",
        "KHR_materials_specular",
        "KHR_materials_transmission",
        "KHR_materials_unlit",
        "KHR_materials_volume",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
    )
)
_LARGEST = float(np.finfo(np.float32).max)
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
_IMAGE_MAGIC = ((b"\x89PNG\r\n\x1a\n", ".png"), (b"\xff\xd8\xff", ".jpg"))

Index = Annotated[int, Meta(ge=0)]
Color = tuple[Fraction, Fraction, Fraction]
Color4 = tuple[Fraction, Fraction, Fraction, Fraction]


class _Object(msgspec.Struct, kw_only=True, frozen=True, rename="camel"):
    """Base of all: unknown keys are let pass."""


# --- buffers and accessors --------------------------------------------------------------------------------------


class Buffer(_Object):
    byte_length: Annotated[int, Meta(ge=1)]
    uri: str | None = None


class BufferView(_Object):
    buffer: Index
    byte_length: Annotated[int, Meta(ge=1)]
    byte_offset: Index = 0
    byte_stride: Annotated[int, Meta(ge=4, le=252)] | None = None


class SparseIndices(_Object):
    buffer_view: Index
    component_type: Literal[5121, 5123, 5125]
    byte_offset: Index = 0


class SparseValues(_Object):
    buffer_view: Index
    byte_offset: Index = 0


class Sparse(_Object):
    count: Annotated[int, Meta(ge=1)]
    indices: SparseIndices
    values: SparseValues


class Accessor(_Object):
    component_type: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Annotated[int, Meta(ge=1)]
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    buffer_view: Index | None = None
    byte_offset: Index = 0
    normalized: bool = False
    sparse: Sparse | None = None
    min: list[float] | None = None
    max: list[float] | None = None


# --- geometry ---------------------------------------------------------------------------------------------------


class Attributes(msgspec.Struct, kw_only=True, frozen=True):
    POSITION: Index | None = None
    NORMAL: Index | None = None
    TEXCOORD_0: Index | None = None
    TEXCOORD_1: Index | None = None
    COLOR_0: Index | None = None


class Primitive(_Object):
    attributes: Attributes
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Meta(ge=0, le=6)] = 4
    targets: list[object] = []


class Mesh(_Object):
    primitives: Annotated[list[Primitive], Meta(min_length=1)]
    name: str = ""
    weights: list[float] = []


# --- materials --------------------------------------------------------------------------------------------------


class Image(_Object):
    uri: str | None = None
    buffer_view: Index | None = None
    name: str = ""


class Sampler(_Object):
    mag_filter: int | None = None
    wrap_s: Literal[33071, 33648, 10497] = 10497
    wrap_t: Literal[33071, 33648, 10497] = 10497


class Texture(_Object):
    sampler: Index | None = None
    source: Index | None = None


class TextureTransform(_Object):
    offset: Vec2 = (0.0, 0.0)
    rotation: float = 0.0
    scale: Vec2 = (1.0, 1.0)
    tex_coord: Annotated[int, Meta(ge=0, le=1)] | None = None


class TextureExtensions(_Object):
    transform: TextureTransform | None = msgspec.field(name="KHR_texture_transform", default=None)


class TextureInfo(_Object):
    index: Index
    tex_coord: Annotated[int, Meta(ge=0, le=1)] = 0
    extensions: TextureExtensions = TextureExtensions()


class NormalTextureInfo(TextureInfo):
    scale: float = 1.0


class MetallicRoughness(_Object):
    base_color_factor: Color4 = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: TextureInfo | None = None
    metallic_factor: Fraction = 1.0
    roughness_factor: Fraction = 1.0
    metallic_roughness_texture: TextureInfo | None = None


class Anisotropy(_Object):
    anisotropy_strength: Fraction = 0.0
    anisotropy_rotation: float = 0.0
    anisotropy_texture: TextureInfo | None = None


class Clearcoat(_Object):
    clearcoat_factor: Fraction = 0.0
    clearcoat_texture: TextureInfo | None = None
    clearcoat_roughness_factor: Fraction = 0.0
    clearcoat_roughness_texture: TextureInfo | None = None
    clearcoat_normal_texture: NormalTextureInfo | None = None


class EmissiveStrength(_Object):
    emissive_strength: NonNegative = 1.0


class Ior(_Object):
    ior: NonNegative = 1.5


class Sheen(_Object):
    sheen_color_factor: Color = (0.0, 0.0, 0.0)
    sheen_color_texture: TextureInfo | None = None
    sheen_roughness_factor: Fraction = 0.0
    sheen_roughness_texture: TextureInfo | None = None


class Specular(_Object):
    specular_factor: Fraction = 1.0
    specular_texture: TextureInfo | None = None
    specular_color_factor: tuple[NonNegative, NonNegative, NonNegative] = (1.0, 1.0, 1.0)
    specular_color_texture: TextureInfo | None = None


class Transmission(_Object):
    transmission_factor: Fraction = 0.0
    transmission_texture: TextureInfo | None = None


class Volume(_Object):
    thickness_factor: NonNegative = 0.0
    thickness_texture: TextureInfo | None = None
    attenuation_distance: Positive | None = None
    attenuation_color: Color = (1.0, 1.0, 1.0)


class Unlit(_Object):
    pass


class MaterialExtensions(_Object):
    anisotropy: Anisotropy | None = msgspec.field(name="KHR_materials_anisotropy", default=None)
    clearcoat: Clearcoat | None = msgspec.field(name="KHR_materials_clearcoat", default=None)
    emissive_strength: EmissiveStrength | None = msgspec.field(name="KHR_materials_emissive_strength", default=None)
    ior: Ior | None = msgspec.field(name="KHR_materials_ior", default=None)
    sheen: Sheen | None = msgspec.field(name="KHR_materials_sheen", default=None)
    specular: Specular | None = msgspec.field(name="KHR_materials_specular", default=None)
    transmission: Transmission | None = msgspec.field(name="KHR_materials_transmission", default=None)
    unlit: Unlit | None = msgspec.field(name="KHR_materials_unlit", default=None)
    volume: Volume | None = msgspec.field(name="KHR_materials_volume", default=None)


class Material(_Object):
    name: str = ""
    pbr: MetallicRoughness = msgspec.field(name="pbrMetallicRoughness", default=MetallicRoughness())
    normal_texture: NormalTextureInfo | None = None
    emissive_texture: TextureInfo | None = None
    emissive_factor: Color = (0.0, 0.0, 0.0)
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: NonNegative = 0.5
    double_sided: bool = False
    extensions: MaterialExtensions = MaterialExtensions()


# --- cameras and lights -----------------------------------------------------------------------------------------


class PerspectiveCamera(_Object):
    yfov: Annotated[float, Meta(gt=0.0, lt=3.141592)]
    aspect_ratio: Positive | None = None


class OrthographicCamera(_Object):
    xmag: Positive
    ymag: Positive


class Camera(_Object):
    type: Literal["perspective", "orthographic"]
    name: str = ""
    perspective: PerspectiveCamera | None = None
    orthographic: OrthographicCamera | None = None


class SpotCone(_Object):
    inner_cone_angle: Annotated[float, Meta(ge=0.0, lt=1.5707964)] = 0.0
    outer_cone_angle: Annotated[float, Meta(gt=0.0, le=1.5707964)] = 0.7853981633974483


class Light(_Object):
    type: Literal["directional", "point", "spot"]
    name: str = ""
    color: Color = (1.0, 1.0, 1.0)
    intensity: NonNegative = 1.0
    range: Positive | None = None
    spot: SpotCone = SpotCone()


class Lights(_Object):
    lights: list[Light] = []


class LightReference(_Object):
    light: Index


# --- the scene graph --------------------------------------------------------------------------------------------


class NodeExtensions(_Object):
    light: LightReference | None = msgspec.field(name="KHR_lights_punctual", default=None)


class Node(_Object):
    name: str = ""
    children: list[Index] = []
    camera: Index | None = None
    mesh: Index | None = None
    skin: Index | None = None
    matrix: Annotated[list[float], Meta(min_length=16, max_length=16)] | None = None
    translation: Vec3 = (0.0, 0.0, 0.0)
    rotation: Vec4 = (0.0, 0.0, 0.0, 1.0)
    scale: Vec3 = (1.0, 1.0, 1.0)
    weights: list[float] = []
    extensions: NodeExtensions = NodeExtensions()


class Scene(_Object):
    nodes: list[Index] = []
    name: str = ""


class Asset(_Object):
    version: str
    min_version: str | None = None


class RootExtensions(_Object):
    lights: Lights = msgspec.field(name="KHR_lights_punctual", default=Lights())


class Root(_Object):
    asset: Asset
    extensions_used: list[str] = []
    extensions_required: list[str] = []
    scene: Index | None = None
    scenes: list[Scene] = []
    nodes: list[Node] = []
    cameras: list[Camera] = []
    meshes: list[Mesh] = []
    materials: list[Material] = []
    textures: list[Texture] = []
    samplers: list[Sampler] = []
    images: list[Image] = []
    accessors: list[Accessor] = []
    buffer_views: list[BufferView] = []
    buffers: list[Buffer] = []
    animations: list[object] = []
    extensions: RootExtensions = RootExtensions()


# --- reading ----------------------------------------------------------------------------------------------------


class Document:
    """A glTF file. Buffers are read when they are first asked for.

    Args:
        path: The ``.gltf`` or ``.glb`` file.
        data: Its bytes.

    Attributes:
        root: The JSON.

    Raises:
        SceneError: The file is damaged, is not glTF 2, or requires an extension that is not supported.
    """

    def __init__(self, path: str | os.PathLike, data: bytes):
        self.path = Path(path)
        text, self._binary = _chunks(data, path) if data[:4] == b"glTF" else (data, None)
        raw = json_format.parse_object(text, path)
        _check_finite(raw, path)
        self.root = _convert(raw, path)
        self._buffers: dict[int, memoryview] = {}
        version = self.root.asset.min_version or self.root.asset.version
        if version.split(".")[0] != "2" or (self.root.asset.min_version or "2.0") != "2.0":
            raise self.error("asset.version", f"version {shown(version)} is not supported; supported: 2.0")
        for i, name in enumerate(self.root.extensions_required):
            if name not in SUPPORTED_EXTENSIONS:
                supported = ", ".join(sorted(SUPPORTED_EXTENSIONS))
                message = f"the extension {shown(name)} is required but not supported; supported: {supported}"
                raise self.error(f"extensionsRequired[{i}]", message)

    def error(self, where: str, message: str) -> SceneError:
        """The error of the place `where` in the JSON."""
        return SceneError(message, self.path, where)

    def item(self, kind: str, index: int, where: str):
        """Entry `index` of a list of the root, such as ``accessors``, to which the place `where` refers.

        Raises:
            SceneError: There is none.
        """
        items = self.lights if kind == "lights" else getattr(self.root, kind)
        if index >= len(items):
            label = "bufferViews" if kind == "buffer_views" else kind
            raise self.error(where, f"index {shown(str(index))[1:-1]} is out of range; {label} has {len(items)}")
        return items[index]

    @property
    def lights(self) -> list[Light]:
        return self.root.extensions.lights.lights

    def view(self, index: int, where: str) -> memoryview:
        """The bytes of a buffer view to which `where` refers. Raises SceneError where they are missing."""
        view = self.item("buffer_views", index, where)
        place = f"bufferViews[{index}]"
        buffer = self._buffer(view.buffer, f"{place}.buffer")
        if view.byte_offset + view.byte_length > len(buffer):
            end = shown(str(view.byte_offset + view.byte_length))[1:-1]
            raise self.error(place, f"ends at byte {end}, but buffers[{view.buffer}] has {len(buffer)} bytes")
        return buffer[view.byte_offset : view.byte_offset + view.byte_length]

    def _buffer(self, index, where):
        if index not in self._buffers:
            buffer = self.item("buffers", index, where)
            place = f"buffers[{index}]"
            if buffer.uri is not None:
                data = self._uri_bytes(buffer.uri, f"{place}.uri")
            elif index == 0 and self._binary is not None:
                data = self._binary
            else:
                raise self.error(place, "has no uri, and the file has no binary chunk for it")
            if len(data) < buffer.byte_length:
                declared = shown(str(buffer.byte_length))[1:-1]
                raise self.error(f"{place}.byteLength", f"{declared} bytes are declared; found {len(data)}")
            self._buffers[index] = memoryview(data)[: buffer.byte_length]
        return self._buffers[index]

    def image_file(self, index: int, where: str) -> Path | None:
        """The file of an image to which `where` refers; None for one that lies inside this file.

        Raises:
            SceneError: There is no such image, or its URI is not a path.
        """
        image = self.item("images", index, where)
        if image.uri is None or image.uri.startswith("data:"):
            return None
        return self._uri_path(image.uri, f"images[{index}].uri")

    def image_bytes(self, index: int, where: str) -> tuple[memoryview | bytes, str]:
        """The bytes and the suffix (.png or .jpg) of an image inside the file, to which `where` refers.

        Raises:
            SceneError: There is no such image, it is a file of its own, or it is neither PNG nor JPEG.
        """
        image = self.item("images", index, where)
        place = f"images[{index}]"
        if image.uri is not None:
            if not image.uri.startswith("data:"):
                raise self.error(place, f"is a file of its own, {shown(image.uri)}")
            data = self._uri_bytes(image.uri, f"{place}.uri")
        elif image.buffer_view is not None:
            data = self.view(image.buffer_view, f"{place}.bufferView")
        else:
            raise self.error(place, "has neither uri nor bufferView")
        for magic, suffix in _IMAGE_MAGIC:
            if bytes(data[: len(magic)]) == magic:
                return data, suffix
        raise self.error(place, "is neither PNG nor JPEG")

    def _uri_bytes(self, uri, where):
        if not uri.startswith("data:"):
            path = self._uri_path(uri, where)
            try:
                return path.read_bytes()
            except FileNotFoundError:
                raise self.error(where, f"file not found: {shown(uri)}") from None
            except OSError as error:
                raise self.error(where, f"{shown(uri)} cannot be read: {error.strerror or error}") from None
        header, comma, text = uri.partition(",")
        if not comma:
            raise self.error(where, "a data URI without a comma")
        try:
            if header.endswith(";base64"):
                return base64.b64decode(urllib.parse.unquote_to_bytes(text), validate=True)
        except (binascii.Error, ValueError) as error:
            raise self.error(where, f"not base64: {str(error)[:1].lower()}{str(error)[1:]}") from None
        return urllib.parse.unquote_to_bytes(text)

    def _uri_path(self, uri, where):
        if _SCHEME.match(uri):
            raise self.error(where, f"{shown(uri)} is not supported; supported: a relative path, or a data URI")
        name = urllib.parse.unquote(uri)
        if not name or "\0" in name:
            raise self.error(where, f"{shown(uri)} is not a path")
        return Path(os.path.abspath(self.path.parent / name))


def open_document(path: str | os.PathLike) -> Document:
    """Reads a glTF file. The last few are remembered as long as they do not change on disk; see `clear_cache`.

    Raises:
        SceneError: As `Document` does, or the file cannot be read.
    """
    try:
        stat = os.stat(path)
        return _open(os.path.abspath(path), stat.st_mtime_ns, stat.st_size)
    except FileNotFoundError:
        raise SceneError("file not found", path) from None
    except OSError as error:
        raise SceneError(f"cannot be read: {error.strerror or error}", path) from None


@functools.lru_cache(maxsize=4)
def _open(path, _mtime, _size):
    return Document(path, Path(path).read_bytes())


def clear_cache() -> None:
    """Lets go of the files that are remembered for the next use."""
    _open.cache_clear()


def _chunks(data, path):
    """The JSON and the binary chunk (or None) of a GLB."""
    if len(data) < 20:
        raise SceneError(f"not a GLB file: it ends after {len(data)} bytes, in its header", path)
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise SceneError(f"GLB version {version} is not supported; supported: 2", path)
    if length > len(data):
        raise SceneError(f"the GLB file is truncated: it has {len(data)} of {length} bytes", path)
    found, position = [], 12
    while position + 8 <= length and len(found) < 2:
        size, kind = struct.unpack_from("<I4s", data, position)
        if position + 8 + size > length:
            message = f"the GLB file is damaged: a chunk of {size} bytes at byte {position} passes the end"
            raise SceneError(message, path)
        found.append((kind, memoryview(data)[position + 8 : position + 8 + size]))
        position += 8 + size
    if not found or found[0][0] != b"JSON":
        raise SceneError("the GLB file is damaged: its first chunk is not JSON", path)
    binary = found[1][1] if len(found) > 1 and found[1][0] == b"BIN\0" else None
    return bytes(found[0][1]), binary


def _convert(raw, path):
    try:
        return msgspec.convert(raw, Root)
    except RecursionError:
        raise SceneError("nested too deeply", path) from None
    except (msgspec.ValidationError, ValueError, OverflowError) as error:
        steps, message, _ = explain(raw, error, Root)
    raise SceneError(message, path, json_format.printable_path(steps))


def _check_finite(raw, path):
    for steps, item in json_format.containers(raw):
        for key, value in item.items():
            for number in value if isinstance(value, list) else (value,):
                if isinstance(number, float) and not abs(number) <= _LARGEST:
                    message = f"expected a number of at most {_LARGEST:.4g}, as 32-bit floats are; found {number:g}"
                    raise SceneError(message, path, json_format.printable_path([*steps, key]))
