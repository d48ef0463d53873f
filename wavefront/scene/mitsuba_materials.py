"""Mitsuba BSDFs, textures and colours to records. Defaults are those of Mitsuba 3.9, whatever the dialect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from wavefront.bsdf.tables import PRINCIPLED_FRACTIONS
from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene.mitsuba_values import Element, to_number, to_numbers
from wavefront.scene.mitsuba_xml import Document, Plugin

SMOOTHEST = 1e-4  # alpha of the roughest surface that is taken as smooth, exclusive

# A constant spectrum that is emitted is equal-energy white, not D65: XYZ (1, 1, 1) in linear Rec. 709 (IEC 61966-2-1).
EQUAL_ENERGY = (1.204794, 0.948291, 0.908916)

_LDR_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tga")


@dataclass
class Materials:
    """Converts BSDFs and textures of a document; those at the top level with an id become named records.

    Attributes:
        document: Where they come from.
        warn: Called with a line of text for what does not change the image.
        used: Named BSDFs and textures that something refers to, by id.
    """

    document: Document
    warn: Callable[[str], object]
    used: dict[str, object] = field(default_factory=dict)

    def __post_init__(self):
        top = (plugin for _, plugin in self.document.scene.children if isinstance(plugin, Plugin))
        self.named = {plugin.id: plugin for plugin in top if plugin.id and plugin.tag in ("bsdf", "texture")}
        self._bsdfs = {
            "diffuse": self._diffuse,
            "roughdiffuse": self._rough_diffuse,
            "conductor": self._conductor,
            "roughconductor": self._conductor,
            "dielectric": self._dielectric,
            "roughdielectric": self._dielectric,
            "thindielectric": self._dielectric,
            "plastic": self._plastic,
            "roughplastic": self._plastic,
            "principled": self._principled,
            "twosided": self._twosided,
            "mask": self._mask,
            "blendbsdf": self._blend,
            "normalmap": self._normal_map,
            "bumpmap": self._bump_map,
            "null": self._null,
        }

    def unused(self) -> None:
        """Converts the named records that nothing refers to; what is wrong with them is a warning."""
        for name, plugin in self.named.items():
            if name in self.used:
                continue
            try:
                self._named(plugin, self._convert_texture if plugin.tag == "texture" else self._convert_bsdf)
            except SceneError as error:
                self.warn(f"{plugin.where()}: {plugin.tag} {name!r} is left out, nothing uses it: {error.message}")

    def records(self, tag: str) -> list:
        """The named records of a kind (``bsdf`` or ``texture``), in file order."""
        return [self.used[name] for name, plugin in self.named.items() if plugin.tag == tag and name in self.used]

    # --- BSDFs -------------------------------------------------------------------------------------------------

    def bsdf(self, plugin: Plugin) -> str | description.Bsdf:
        """The record of a BSDF, or its name if it stands at the top level with an id.

        Raises:
            SceneError: With file and line: a kind, a property or a value that is not supported.
        """
        if self.named.get(plugin.id) is plugin:
            self._named(plugin, self._convert_bsdf)
            return plugin.id
        return self._convert_bsdf(plugin)

    def _named(self, plugin, convert):
        if plugin.id not in self.used:
            record = convert(plugin)
            record.name = plugin.id
            self.used[plugin.id] = record

    def _convert_bsdf(self, plugin):
        if plugin.type not in self._bsdfs:
            raise plugin.error(f"{plugin.label()} is not supported; supported: {', '.join(self._bsdfs)}")
        return self._bsdfs[plugin.type](plugin)

    def _diffuse(self, plugin):
        record = description.Diffuse(reflectance=self.colour(plugin, "reflectance", 0.5, limit=1.0))
        plugin.finish("texture")
        return record

    def _rough_diffuse(self, plugin):
        """Of Mitsuba 0.x; its alpha is a slope, of which Oren and Nayar's sigma is alpha / sqrt(2).

        The roughness is the one that gives the model's two terms, A + B ..., the same ratio (Oren and Nayar 1994,
        section 4.2, without interreflection).
        """
        reflectance = self.colour(plugin, "reflectance", 0.5, limit=1.0)
        alpha = self.scalar(plugin, "alpha", 0.2)
        plugin.ignore("use_fast_approx")
        plugin.finish("texture")
        if not isinstance(alpha, float):
            raise plugin.error(f"{plugin.label()} needs a number alpha; a texture is not supported")
        variance = 0.5 * alpha * alpha
        a = 1.0 - 0.5 * variance / (variance + 0.33)
        b = 0.45 * variance / (variance + 0.09)
        return description.OrenNayar(reflectance=reflectance, roughness=b / a)

    def _conductor(self, plugin):
        fields = self._conductor_spectrum(plugin)
        fields["specular_reflectance"] = self.colour(plugin, "specular_reflectance", 1.0, limit=1.0)
        if plugin.type == "roughconductor":
            fields |= self._roughness(plugin)
        plugin.finish("texture")
        return (description.RoughConductor if "distribution" in fields else description.Conductor)(**fields)

    def _conductor_spectrum(self, plugin):
        material = plugin.string("material", "")
        given = plugin.has("eta") or plugin.has("k")
        if material and given:
            raise plugin.error(f"{plugin.label()} has either material or eta and k")
        exterior = self._ior(plugin, "ext_eta", 1.0)
        if exterior != 1.0 and not isinstance(exterior, str) and not material and given:
            scale = 1.0 / exterior  # Mitsuba 0.x: relative to the medium outside
        elif exterior in (1.0, "air", "vacuum"):
            scale = 1.0
        else:
            raise plugin.error(f"ext_eta is supported as a number beside eta and k, not as {exterior!r}")
        if material and material != "none":
            return {"material": material}
        if not material and not given and self.document.version < (2,):
            self.warn(f"{plugin.where()}: {plugin.label()} without a material is a perfect mirror, as in Mitsuba 3")
        return {
            "eta": _scaled(plugin, self.colour(plugin, "eta", 0.0), scale),
            "k": _scaled(plugin, self.colour(plugin, "k", 1.0), scale),
        }

    def _dielectric(self, plugin):
        fields = {}
        for name, default in (("int_ior", 1.5046), ("ext_ior", 1.000277)):
            fields[name] = self._ior(plugin, name, default)
        for name in ("specular_reflectance", "specular_transmittance"):
            fields[name] = self.colour(plugin, name, 1.0, limit=1.0)
        if plugin.type == "roughdielectric":
            fields |= self._roughness(plugin)
        plugin.finish("texture")
        if plugin.type == "thindielectric":
            return description.ThinDielectric(**fields)
        return (description.RoughDielectric if "distribution" in fields else description.Dielectric)(**fields)

    def _plastic(self, plugin):
        fields = {"nonlinear": plugin.boolean("nonlinear")}
        for name, default in (("int_ior", 1.49), ("ext_ior", 1.000277)):
            fields[name] = self._ior(plugin, name, default)
        for name, default in (("diffuse_reflectance", 0.5), ("specular_reflectance", 1.0)):
            fields[name] = self.colour(plugin, name, default, limit=1.0)
        if plugin.type == "roughplastic":
            if plugin.has("alpha_u") or plugin.has("alpha_v") or plugin.child("alpha") is not None:
                raise plugin.error(f"{plugin.label()} needs one number alpha for both directions")
            fields |= self._roughness(plugin)
        plugin.finish("texture")
        return (description.RoughPlastic if "distribution" in fields else description.Plastic)(**fields)

    def _principled(self, plugin):
        fields = {"base_color": self.colour(plugin, "base_color", 0.5, limit=1.0)}
        for name in PRINCIPLED_FRACTIONS:
            fields[name] = self.scalar(plugin, name, getattr(description.Principled(), name), limit=1.0)
        if plugin.has("eta") and plugin.has("specular"):
            raise plugin.error(f"{plugin.label()} has either eta or specular")
        for name, allowed, is_allowed in (
            ("eta", "greater than 0", lambda value: value > 0.0),
            ("specular", "from 0 to 1", lambda value: 0.0 <= value <= 1.0),
            ("main_specular_sampling_rate", "greater than 0", lambda value: value > 0.0),
            ("clearcoat_sampling_rate", "at least 0", lambda value: value >= 0.0),
            ("diffuse_reflectance_sampling_rate", "at least 0", lambda value: value >= 0.0),
        ):
            if plugin.child(name) is not None:
                raise plugin.error(f"{name} of {plugin.label()} must be a number, not a texture")
            if plugin.has(name):
                value = fields[name] = plugin.number(name)
                if not is_allowed(value):
                    raise plugin.get(name).error(f"{name} must be {allowed}; found {value:g}")
        plugin.finish("texture")
        return description.Principled(**fields)

    def _ior(self, plugin, name, default):
        element = plugin.get(name)
        if element is None:
            return default
        if element.tag == "string":
            # Mitsuba 0.x also took the number as a string
            text = plugin.string(name, "")
            try:
                value = float(text)
            except ValueError:
                return text
        else:
            value = plugin.number(name)
        if not value > 0.0:
            raise element.error(f"{name} must be greater than 0; found {value:g}")
        return value

    def _roughness(self, plugin):
        distribution = plugin.string("distribution", "beckmann", ("beckmann", "ggx"))
        plugin.ignore("sample_visible")
        directions = [name for name in ("alpha_u", "alpha_v") if plugin.has(name)]
        if directions:
            if plugin.has("alpha"):
                raise plugin.error("alpha excludes alpha_u and alpha_v")
            if len(directions) == 1:
                raise plugin.error("alpha_u and alpha_v must be given together")
            fields = {name: self.scalar(plugin, name, 0.1) for name in directions}
            if fields["alpha_u"] == fields["alpha_v"]:
                fields = {"alpha": fields["alpha_u"]}
        else:
            fields = {"alpha": self.scalar(plugin, "alpha", 0.1)}
        for name, value in fields.items():
            if isinstance(value, float) and value > 1.0:
                raise plugin.error(f"{name} must be at most 1; found {value:g}")
        if all(_is_smooth(value) for value in fields.values()):
            return {}
        if any(_is_smooth(value) for value in fields.values()):
            raise plugin.error(f"alpha_u and alpha_v must both be below {SMOOTHEST:g}, or neither")
        if fields.get("alpha") == 0.1:
            del fields["alpha"]  # the default
        return fields | {"distribution": distribution}

    def _twosided(self, plugin):
        sides = plugin.objects("bsdf")
        plugin.finish("bsdf")
        if len(sides) not in (1, 2):
            raise plugin.error(f"{plugin.label()} needs one or two BSDFs; found {len(sides)}")
        return description.TwoSided(front=self.bsdf(sides[0]), back=self.bsdf(sides[1]) if len(sides) == 2 else None)

    def _mask(self, plugin):
        opacity = self.scalar(plugin, "opacity", 0.5, limit=1.0)
        nested = plugin.objects("bsdf")
        plugin.finish("bsdf", "texture")
        if len(nested) != 1:
            raise plugin.error(f"{plugin.label()} needs one BSDF; found {len(nested)}")
        return description.Mask(opacity=opacity, bsdf=self.bsdf(nested[0]))

    def _blend(self, plugin):
        weight = self.scalar(plugin, "weight", None, limit=1.0)
        nested = plugin.objects("bsdf")
        plugin.finish("bsdf", "texture")
        if len(nested) != 2:
            raise plugin.error(f"{plugin.label()} needs two BSDFs; found {len(nested)}")
        if weight is None:
            raise plugin.error(f"{plugin.label()} needs a weight")
        return description.Blend(first=self.bsdf(nested[0]), second=self.bsdf(nested[1]), weight=weight)

    def _map_fields(self, plugin):
        fields = {
            "flip_invalid_normals": plugin.boolean("flip_invalid_normals", True),
            "shadowing": plugin.boolean("use_shadowing_function", True),
        }
        nested = plugin.objects("bsdf")
        plugin.finish("bsdf", "texture")
        if len(nested) != 1:
            raise plugin.error(f"{plugin.label()} needs one BSDF; found {len(nested)}")
        return fields | {"bsdf": self.bsdf(nested[0])}

    def _normal_map(self, plugin):
        texture = plugin.child("normalmap")
        normal = self.colour(plugin, "normalmap", None, 1.0) if texture is None else self._texture(texture, True, 1.0)
        if normal is None:
            raise plugin.error(f"{plugin.label()} needs a normalmap")
        normal = [normal] * 3 if isinstance(normal, float) else normal
        return description.NormalMap(normal=normal, **self._map_fields(plugin))

    def _bump_map(self, plugin):
        """Its texture may have any name."""
        given = [(name, child) for name, child in plugin.resolved() if child.tag == "texture"]
        plugin.known.update(name for name, _ in given)
        scale = plugin.number("scale", 1.0)
        fields = self._map_fields(plugin)
        if len(given) != 1:
            raise plugin.error(f"{plugin.label()} needs one texture; found {len(given)}")
        height = self._texture(given[0][1], True, None)
        if not isinstance(height, description.Bitmap):
            raise plugin.error(f"{plugin.label()} needs a bitmap")
        return description.BumpMap(height=height, scale=scale, **fields)

    def _null(self, plugin):
        plugin.finish()
        return description.Null()

    # --- colours and textures ----------------------------------------------------------------------------------

    def colour(self, plugin: Plugin, name: str, default, limit: float | None = None, emitted: bool = False):
        """A grey value, a list of three, the name of a texture, or a texture.

        Args:
            plugin: What has the property.
            name: The property.
            default: Where it is not given.
            limit: The largest value allowed.
            emitted: It is a radiance: a constant spectrum is then equal-energy white.
        """
        texture = plugin.child(name)
        if texture is not None:
            return self._texture(texture, False, limit)
        element = plugin.get(name)
        return default if element is None else colour_value(element, limit, emitted)

    def scalar(self, plugin: Plugin, name: str, default: float, limit: float | None = None):
        """A number, the name of a texture, or a texture, for a parameter that is not a colour."""
        texture = plugin.child(name)
        if texture is not None:
            return self._texture(texture, True, limit)
        element = plugin.get(name)
        if element is None:
            return default
        value = colour_value(element, limit)
        if isinstance(value, list):
            if len(set(value)) > 1:
                raise element.error(f"{name!r} must be one number, not a colour")
            value = value[0]
        return value

    def _texture(self, plugin, scalar, limit):
        if plugin.type == "uniform":
            element = plugin.get("value")
            plugin.finish()
            return 1.0 if element is None else colour_value(element, limit)
        if not scalar and self.named.get(plugin.id) is plugin:
            self._named(plugin, self._convert_texture)
            return plugin.id
        # a named texture is encoded as a colour; where a number is wanted, a copy says how it is encoded there
        return self._convert_texture(plugin, scalar)

    def _convert_texture(self, plugin, scalar=False):
        if plugin.tag != "texture":
            raise plugin.error(f"{plugin.label()} cannot be used as a texture")
        if plugin.type == "bitmap":
            return self._bitmap(plugin, scalar)
        if plugin.type == "checkerboard":
            colours = {name: self.colour(plugin, name, value) for name, value in (("color0", 0.4), ("color1", 0.2))}
            for name, value in colours.items():
                if not isinstance(value, (float, list)):
                    raise plugin.error(f"{name} of a checkerboard must be a colour, not a texture")
            if scalar:  # where a number is wanted, Mitsuba 3.9 has the two swapped
                colours = {"color0": colours["color1"], "color1": colours["color0"]}
            record = description.Checkerboard(**colours, uv_transform=_uv_transform(plugin))
            plugin.finish()
            return record
        if plugin.type == "scale":
            return self._scale(plugin, scalar)
        raise plugin.error(f"{plugin.label()} is not supported; supported: bitmap, checkerboard, scale, uniform")

    def _scale(self, plugin, scalar):
        """Of Mitsuba 0.x: another texture times a number."""
        nested = plugin.objects("texture")
        factor = self.scalar(plugin, "scale", 1.0)
        plugin.finish("texture")
        if len(nested) != 1 or not isinstance(factor, float):
            raise plugin.error(f"{plugin.label()} needs one texture and a number")
        record = self._convert_texture(nested[0], scalar)
        if isinstance(record, description.Bitmap):
            record.scale *= factor
        else:
            record.color0, record.color1 = (_scaled(plugin, c, factor) for c in (record.color0, record.color1))
        return record

    def _bitmap(self, plugin, scalar):
        element = plugin.get("filename")
        if element is None:
            raise plugin.error(f"{plugin.label()} needs a filename")
        file = self.document.find(plugin.string("filename", ""), element)
        raw = plugin.boolean("raw")
        plugin.ignore("format", "accel", "cache", "max_anisotropy")
        gamma = plugin.number("gamma", -1.0)
        if gamma not in (-1.0, 1.0):
            raise plugin.get("gamma").error(f"gamma {gamma:g} is not supported; allowed: 1 (linear), -1 (automatic)")
        if raw or gamma == 1.0:
            space = "linear"
        else:
            # Mitsuba linearises 8-bit images even where they stand for a number
            space = "srgb" if scalar and file.suffix.lower() in _LDR_SUFFIXES else "auto"
        kinds = ("bilinear", "nearest", "trilinear", "ewa")
        kind = plugin.string("filter_type", "bilinear", kinds)
        if kind in kinds[2:]:
            self.warn(f"{plugin.where()}: texture filter {kind!r} is taken as 'bilinear'")
        record = description.Bitmap(
            file=str(file),
            color_space=space,
            filter="nearest" if kind == "nearest" else "bilinear",
            wrap=self._wrap(plugin),
            uv_transform=_uv_transform(plugin),
        )
        plugin.finish()
        return record

    def _wrap(self, plugin):
        modes = ("repeat", "mirror", "clamp")
        found = {plugin.string(name, "repeat", modes) for name in _WRAPS if plugin.has(name)}
        if len(found) > 1:
            raise plugin.error("different wrap modes for u and v are not supported")
        return found.pop() if found else "repeat"


_WRAPS = ("wrap_mode", "wrap_mode_u", "wrap_mode_v")


def colour_value(element: Element, limit: float | None = None, emitted: bool = False) -> float | list[float]:
    """A float, or a list of three, from <float>, <integer>, <rgb>, <srgb> or a constant <spectrum>, linear Rec. 709.

    Raises:
        SceneError: With file and line: another element, negative or above `limit`, a sampled spectrum.
    """
    tag = element.tag
    if tag not in ("float", "integer", "rgb", "srgb", "spectrum"):
        raise element.error(f"{element.attributes.get('name')!r} must be a colour, not <{tag}>")
    if tag == "spectrum" and "filename" in element.attributes:
        raise element.error("spectra from files are not supported; use <rgb>")
    element.check_attributes("name", "value", *(["intent"] if tag == "spectrum" else []))
    text = element.attribute("value")
    if tag in ("float", "integer"):
        value = to_number(element, text)
    elif tag == "spectrum":
        if ":" in text:
            raise element.error("sampled spectra are not supported; use <rgb>, or a <spectrum> with one number")
        value = to_number(element, text)
        if emitted:
            value = [channel * value for channel in EQUAL_ENERGY]
    else:
        value = _three(element, text)
        if tag == "srgb":
            value = [_decode(channel) for channel in value]
    values = value if isinstance(value, list) else [value]
    if min(values) < 0.0 or (limit is not None and max(values) > limit):
        allowed = "at least 0" if limit is None else f"from 0 to {limit:g}"
        raise element.error(f"{element.attributes.get('name')!r} must be {allowed}; found {text!r}")
    return value


def _three(element, text):
    text = text.strip()
    if element.tag == "srgb" and text.startswith("#"):
        try:
            if len(text) != 7:
                raise ValueError
            return [int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
        except ValueError:
            raise element.error(f"{text!r} is not a colour such as #a0b0c0") from None
    numbers = to_numbers(element, text)
    if len(numbers) not in (1, 3):
        raise element.error(f"<{element.tag}> needs one or three numbers; found {len(numbers)}")
    return numbers * (3 // len(numbers))


def _decode(value):
    """sRGB to linear (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def _is_smooth(alpha):
    return isinstance(alpha, float) and alpha < SMOOTHEST


def _scaled(plugin, value, scale):
    if scale == 1.0:
        return value
    if isinstance(value, float):
        return value * scale
    if isinstance(value, list):
        return [channel * scale for channel in value]
    raise plugin.error("ext_eta beside a textured eta or k is not supported")


def _uv_transform(plugin):
    """Rows of the 2x3 matrix in a to_uv, of which Mitsuba leaves out what belongs to z."""
    matrix = plugin.transform("to_uv")
    if matrix is None:
        return description.IDENTITY_UV
    return tuple((float(row[0]), float(row[1]), float(row[3])) for row in matrix[:2])
