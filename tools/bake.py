"""Lets Mitsuba bake its `sunsky` to an environment map and a disc, so that both renderers can use the same light.

Mitsuba's sky (Hosek and Wilkie 2012) is a model of its own; baked, it is data. `bake_sunsky` makes the data from a
Mitsuba XML file, `replace_records` puts it into our records, and `baked_xml` into a copy of the XML, which `load_xml`
of `tools.peers.mitsuba` takes as it takes the original:

    baked = bake_sunsky("scene.xml", folder)
    ours = replace_records(load_scene("scene.xml"), baked)
    theirs = load_xml(baked_xml("scene.xml", baked, folder / "baked.xml"), width, height)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from tools.peers.mitsuba import missing, require
from wavefront.errors import WavefrontError
from wavefront.scene import description
from wavefront.scene.images import replacing, write_exr

ROWS = 512
DISTANCE = 1e6  # of the disc in Mitsuba, metres
_GRID = 512  # directions along each coordinate of the cone around the sun
_WAYS = ("llvm_ad_rgb", "scalar_rgb")


@dataclasses.dataclass(frozen=True)
class BakedSunSky:
    """A sky and a sun as data.

    Attributes:
        sky: Environment map without the sun's disc, to be scaled by nothing; None where the sky has no radiance.
        sun: A disc of even radiance with the irradiance of Mitsuba's; None where the sun has none.
        behind: Mean radiance of the sky over the disc, [3].
    """

    sky: description.Envmap | None
    sun: description.Sun | None
    behind: np.ndarray


def bake_sunsky(
    xml_path: str | Path, folder: str | Path, parameters: Mapping[str, object] | None = None, rows: int = ROWS
) -> BakedSunSky:
    """Evaluates the `sunsky` of a Mitsuba scene and writes ``sunsky.exr`` into `folder`.

    The sun is averaged over its disc: Mitsuba's is darker at its limb. Mitsuba's variant is changed and put back.

    Args:
        xml_path: The scene.
        folder: An existing folder for the image.
        parameters: Values for ``$name`` in the scene.
        rows: Of the image; even, so that the horizon lies in the middle of a row of cells.

    Raises:
        WavefrontError: Mitsuba is missing or does not take the emitter, the scene does not have one `sunsky`, or the
            image cannot be written.
    """
    mi = require()
    variant = next((name for name in _WAYS if missing(name) is None), None)
    if variant is None:
        raise WavefrontError(missing(_WAYS[-1]))
    previous = mi.variant()
    mi.set_variant(variant)
    try:
        return _bake(mi, Path(xml_path), Path(folder), parameters or {}, rows)
    finally:
        if previous is not None:
            mi.set_variant(previous)


def _bake(mi, xml_path, folder, parameters, rows):
    emitter = _load(mi, xml_path, parameters)
    settings = mi.traverse(emitter)
    scales = {name: float(np.ravel(settings[name])[0]) for name in ("sky_scale", "sun_scale")}
    to_sun = np.array(settings["sun_direction"], np.float64).ravel()
    to_sun /= np.linalg.norm(to_sun)
    to_world = _matrix(settings["to_world"])

    def radiance(directions, part):
        for name, scale in scales.items():
            settings[name] = scale if name == part else 0.0
        settings.update()
        return _evaluate(mi, emitter, directions)

    # Mitsuba's zenith is local +Z; that of an environment map +Y.
    turn = to_world @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    theta = np.linspace(0.0, np.pi, rows)[:, None]
    phi = np.pi * (np.arange(2 * rows) + 0.5) / rows
    grid = np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta))
    pixels = np.maximum(radiance(np.stack(grid, axis=-1).reshape(-1, 3) @ turn.T, "sky_scale"), 0.0)
    sky = None
    if scales["sky_scale"] > 0.0:
        file = folder / "sunsky.exr"
        planes = np.moveaxis(pixels.reshape(rows, 2 * rows, 3), 2, 0)
        write_exr(file, dict(zip("RGB", planes, strict=True)))
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        sky = description.Envmap(file=str(file), to_world=[tuple(map(float, row)) for row in matrix])
    angle = _sun_angle(lambda w: radiance(w, "sun_scale"), to_sun) if scales["sun_scale"] > 0.0 else 0.0
    if angle == 0.0:
        return BakedSunSky(sky, None, np.zeros(3))
    # A cone a little wider than the disc, so that its rim counts as Mitsuba has it.
    cone = 2.0 * np.sin(0.5 * 1.02 * angle) ** 2
    u, v = (np.ravel(x) for x in np.meshgrid(*[(np.arange(_GRID) + 0.5) / _GRID] * 2))
    directions, cosine = _around(to_sun, u * cone, 2.0 * np.pi * v)
    irradiance = 2.0 * np.pi * cone * (radiance(directions, "sun_scale") * cosine[:, None]).mean(axis=0)
    directions, cosine = _around(to_sun, u * 2.0 * np.sin(0.5 * angle) ** 2, 2.0 * np.pi * v)
    behind = (radiance(directions, "sky_scale") * cosine[:, None]).sum(axis=0) / cosine.sum()
    sun = description.Sun(
        direction=tuple(map(float, -to_sun)),
        angle=float(np.degrees(angle)),
        radiance=np.maximum(irradiance / (np.pi * np.sin(angle) ** 2), 0.0).tolist(),
    )
    return BakedSunSky(sky, sun, np.maximum(behind, 0.0))


def _load(mi, path, parameters):
    """Mitsuba's emitter, from a scene that holds it alone."""
    root = _parse(path)
    emitter = _the_sunsky(root, path)
    alone = ElementTree.Element("scene", root.attrib)
    alone.extend([element for element in root if element.tag == "default"])
    alone.append(emitter)
    try:
        given = {name: str(value) for name, value in parameters.items()}
        scene = mi.load_string(ElementTree.tostring(alone, encoding="unicode"), **given)
    except RuntimeError as error:
        raise WavefrontError(f"{path}: Mitsuba: {' '.join(str(error).split())}") from None
    return scene.emitters()[0]


def _parse(path):
    try:
        return ElementTree.parse(path).getroot()
    except OSError as error:
        raise WavefrontError(f"{path}: {error.strerror or error}") from None
    except ElementTree.ParseError as error:
        raise WavefrontError(f"{path}: not a Mitsuba scene: {error}") from None


def _the_sunsky(root, path):
    found = [element for element in root if element.tag == "emitter" and element.get("type") == "sunsky"]
    if len(found) != 1:
        raise WavefrontError(f"{path}: needs one emitter 'sunsky' at the top level to bake; found {len(found)}")
    return found[0]


def _matrix(transform):
    """The rotation of Mitsuba's transform, [3, 3] float64."""
    matrix = np.array(transform.matrix, np.float64)
    matrix = matrix.reshape(4, 4) if matrix.size == 16 else matrix[..., 0]
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    return u @ vt


def _evaluate(mi, emitter, directions):
    """Radiance from unit vectors towards the sky, [N, 3]."""
    if mi.variant().startswith("scalar"):
        si, result = mi.SurfaceInteraction3f(), np.empty(directions.shape)
        for i, direction in enumerate(directions):
            si.wi = mi.Vector3f(*(-direction).tolist())
            result[i] = np.array(emitter.eval(si)).ravel()
        return result
    import drjit

    si = drjit.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = mi.Vector3f(*(-directions.T.astype(np.float32)))
    return np.array(emitter.eval(si), np.float64).T


def _around(axis, one_minus_cos, phi):
    """Unit vectors around an axis, and their cosines to it."""
    s = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
    s /= np.linalg.norm(s)
    t = np.cross(axis, s)
    cosine = 1.0 - one_minus_cos
    sine = np.sqrt(one_minus_cos * (2.0 - one_minus_cos))
    return cosine[:, None] * axis + sine[:, None] * (np.cos(phi)[:, None] * s + np.sin(phi)[:, None] * t), cosine


def _sun_angle(radiance, to_sun):
    """Angular radius of the disc, found by where it ends; 0 where the sun does not shine."""
    low, high = 0.0, 0.5 * np.pi
    for _ in range(2):
        angles = np.linspace(low, high, 4096)
        # Upwards from the sun, where no horizon cuts the disc, is one of eight ways around it.
        ways = [_around(to_sun, 2.0 * np.sin(0.5 * angles) ** 2, np.full(len(angles), k * np.pi / 4)) for k in range(8)]
        lit = np.any([radiance(directions).max(axis=1) > 0.0 for directions, _ in ways], axis=0)
        if not lit.any():
            return 0.0
        last = int(np.flatnonzero(lit)[-1])
        low, high = angles[last], angles[min(last + 1, len(angles) - 1)]
    return 0.5 * (low + high)


# --- putting it in place -------------------------------------------------------------------------------------------


def replace_records(scene: description.Scene, baked: BakedSunSky) -> description.Scene:
    """Puts the baked light in the place of the `sunsky` in our records, which are changed and returned."""
    new = [record for record in (baked.sky, baked.sun) if record is not None]
    emitters = []
    for emitter in scene.emitters:
        emitters += new if isinstance(emitter, description.SunSky) else [emitter]
    scene.emitters = emitters
    return scene


def baked_xml(xml_path: str | Path, baked: BakedSunSky, out: str | Path) -> Path:
    """Writes a copy of a Mitsuba scene with the baked light: an `envmap`, and a far `disk` that emits.

    The disc hides the sky behind it, and so emits that too. Other files that the scene names become absolute paths.

    Returns:
        `out`.

    Raises:
        WavefrontError: The scene has no `sunsky`, or the copy cannot be written.
    """
    xml_path, out = Path(xml_path), Path(out)
    root = _parse(xml_path)
    old = _the_sunsky(root, xml_path)
    for element in root.iter("string"):
        file = xml_path.resolve().parent / element.get("value", "")
        if element.get("name") == "filename" and file.is_file():
            element.set("value", str(file))
    place = list(root).index(old)
    root.remove(old)
    if baked.sun is not None:
        root.insert(place, _disk(baked))
    if baked.sky is not None:
        sky = ElementTree.Element("emitter", type="envmap")
        ElementTree.SubElement(sky, "string", name="filename", value=str(Path(baked.sky.file).resolve()))
        _transform(sky, np.array(baked.sky.to_world))
        root.insert(place, sky)
    with replacing(out) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    return out


def _disk(baked):
    to_sun = -np.array(baked.sun.direction)
    s = np.cross(np.eye(3)[np.argmin(np.abs(to_sun))], to_sun)
    s /= np.linalg.norm(s)
    radius = DISTANCE * np.tan(np.radians(baked.sun.angle))
    matrix = np.eye(4)
    # It emits along its +Z, away from the sun.
    matrix[:3, :3] = radius * np.stack([s, np.cross(-to_sun, s), -to_sun], axis=1)
    matrix[:3, 3] = DISTANCE * to_sun
    shape = ElementTree.Element("shape", type="disk")
    _transform(shape, matrix)
    black = ElementTree.SubElement(shape, "bsdf", type="diffuse")
    ElementTree.SubElement(black, "rgb", name="reflectance", value="0, 0, 0")
    emitter = ElementTree.SubElement(shape, "emitter", type="area")
    radiance = ", ".join(repr(float(x)) for x in baked.sun.radiance + baked.behind)
    ElementTree.SubElement(emitter, "rgb", name="radiance", value=radiance)
    return shape


def _transform(parent, matrix):
    element = ElementTree.SubElement(parent, "transform", name="to_world")
    ElementTree.SubElement(element, "matrix", value=" ".join(repr(float(x)) for x in np.ravel(matrix)))
