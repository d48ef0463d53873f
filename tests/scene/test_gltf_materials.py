"""glTF materials: each property against the record written by hand, textures against their pixels, errors, warnings."""

import io
import math

import numpy as np
import pytest
from PIL import Image

from tools.gltf_writer import GltfBuilder
from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene import load_scene
from wavefront.scene.texture_upload import TextureAtlas, load_bitmap

TRIANGLE = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32)
RGBA = np.random.default_rng(5).integers(0, 256, (3, 5, 4), np.uint8)


def png(pixels=RGBA, mode="PNG", **options):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, mode, **options)
    return file.getvalue()


@pytest.fixture
def builder():
    return GltfBuilder()


def load(builder, tmp_path, material=None, suffix=".glb", **fields):
    """The scene of one triangle, its BSDF and its warnings."""
    if fields or material is not None:
        material = builder.add("materials", **fields) if material is None else material
    builder.scene(builder.add("nodes", mesh=builder.mesh(TRIANGLE, uvs=TRIANGLE[:, :2], material=material)))
    builder.scene(builder.add("nodes"))  # no camera is made twice
    path, found = builder.write(tmp_path / f"a{suffix}"), []
    scene = load_scene(path, warn=found.append)
    left_out = [text.removeprefix(f"{path}: ") for text in found if "materials[" in text or "textures[" in text]
    return scene, scene.bsdfs[0], left_out


def principled(**fields):
    return d.Principled(**({"base_color": 1.0, "metallic": 1.0, "roughness": 1.0} | fields))


# --- factors ---------------------------------------------------------------------------------------------------


def test_the_material_of_a_primitive_without_one(builder, tmp_path):
    builder.scene(builder.add("nodes", mesh=builder.mesh(TRIANGLE)))
    scene = load_scene(builder.write(tmp_path / "a.glb"))
    assert scene.bsdfs == [principled(name="default material")]
    assert scene.shapes[0].bsdf == "default material"


def test_factors(builder, tmp_path):
    pbr = {"baseColorFactor": [0.5, 0.25, 1, 0.3], "metallicFactor": 0.75, "roughnessFactor": 0.125}
    scene, bsdf, warnings = load(builder, tmp_path, name="paint", pbrMetallicRoughness=pbr, emissiveFactor=[1, 0, 0.5])
    # alpha has no meaning in a material that is opaque
    assert bsdf == principled(name="paint", base_color=[0.5, 0.25, 1.0], metallic=0.75, roughness=0.125)
    assert scene.shapes[0].emitter == d.Area(radiance=[1.0, 0.0, 0.5])
    assert warnings == []


def test_double_sided_and_emissive_strength(builder, tmp_path):
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 6}}
    scene, bsdf, _ = load(builder, tmp_path, doubleSided=True, emissiveFactor=[0.5, 0.5, 0.5], extensions=strength)
    assert bsdf == d.TwoSided(name="material 0", front=principled())
    assert scene.shapes[0].emitter == d.Area(radiance=3.0, two_sided=True)


def test_names_are_made_unique(builder, tmp_path):
    one, two = builder.add("materials", name="m"), builder.add("materials", name="m")
    for material in (one, two, two):
        builder.scene(0, 1, 2)
        builder.add("nodes", mesh=builder.mesh(TRIANGLE, material=material), name="n")
    scene = load_scene(builder.write(tmp_path / "a.glb"))
    assert [bsdf.name for bsdf in scene.bsdfs] == ["m", "m 2"]
    assert [(shape.name, shape.bsdf) for shape in scene.shapes] == [("n", "m"), ("n 2", "m 2"), ("n 3", "m 2")]


@pytest.mark.parametrize(
    ("fields", "cutoff"), [({"alphaMode": "BLEND"}, None), ({"alphaMode": "MASK", "alphaCutoff": 0.25}, 0.25)]
)
def test_alpha(builder, tmp_path, fields, cutoff):
    pbr = {"baseColorFactor": [1, 1, 1, 0.5], "baseColorTexture": {"index": builder.texture(png())}}
    _, bsdf, _ = load(builder, tmp_path, pbrMetallicRoughness=pbr, **fields)
    file = str(tmp_path / "a.glb")
    opacity = d.Bitmap(file=file, image=0, channel="a", color_space="linear", scale=0.5)
    color = d.Bitmap(file=file, image=0, color_space="srgb")
    assert bsdf == d.Mask(name="material 0", bsdf=principled(base_color=color), opacity=opacity, cutoff=cutoff)


def test_alpha_that_changes_nothing(builder, tmp_path):
    for fields in ({"alphaMode": "BLEND"}, {"alphaMode": "MASK", "alphaCutoff": 0}):
        _, bsdf, _ = load(GltfBuilder(), tmp_path, **fields)
        assert bsdf == principled(name="material 0")


# --- textures --------------------------------------------------------------------------------------------------


def test_textures_and_their_factors(builder, tmp_path):
    texture = {"index": builder.texture(png())}
    pbr = {"baseColorTexture": texture, "metallicRoughnessTexture": texture, "baseColorFactor": [1, 0.5, 0.25, 1],
           "metallicFactor": 0.5, "roughnessFactor": 0.75}  # fmt: skip
    scene, bsdf, warnings = load(
        builder, tmp_path, pbrMetallicRoughness=pbr, emissiveTexture=texture, emissiveFactor=[1, 1, 1]
    )
    image = {"file": str(tmp_path / "a.glb"), "image": 0}
    number = image | {"color_space": "linear"}
    assert bsdf == d.Principled(
        name="material 0",
        base_color=d.Bitmap(**image, color_space="srgb", scale=[1.0, 0.5, 0.25]),
        metallic=d.Bitmap(**number, channel="b", scale=0.5),
        roughness=d.Bitmap(**number, channel="g", scale=0.75),
    )
    assert scene.shapes[0].emitter.radiance == d.Bitmap(**image, color_space="srgb")
    assert warnings == []


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("depth", [8, 16])
def test_pixels_of_channels(builder, tmp_path, suffix, depth):
    if depth == 8:
        pixels, data = RGBA, png()
    else:
        import OpenImageIO as oiio

        pixels = np.random.default_rng(6).integers(0, 65536, (3, 5, 4), np.uint16)
        output = oiio.ImageOutput.create("a.png")
        spec = oiio.ImageSpec(5, 3, 4, "uint16")
        spec.attribute("oiio:UnassociatedAlpha", 1)
        output.open(str(tmp_path / "a.png"), spec)
        output.write_image(pixels)
        output.close()
        data = (tmp_path / "a.png").read_bytes()
    builder.texture(data)
    (tmp_path / "b.png").write_bytes(data)
    builder.write(tmp_path / f"a{suffix}")
    for fields in ({"file": str(tmp_path / f"a{suffix}"), "image": 0}, {"file": str(tmp_path / "b.png")}):
        for i, channel in enumerate("rgba"):
            found = load_bitmap(d.Bitmap(**fields, channel=channel), "")
            assert found.dtype == pixels.dtype
            np.testing.assert_array_equal(found[:, :, 0], pixels[:, :, i])
        np.testing.assert_array_equal(load_bitmap(d.Bitmap(**fields), ""), pixels[:, :, :3])


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "grey.png", "palette.png", "a.exr", "a.tif"])
def test_alpha_of_images_without_it(tmp_path, name):
    path = tmp_path / name
    if name == "a.exr":
        from wavefront.scene.images import write_exr

        write_exr(path, {channel: np.full((2, 3), 0.5) for channel in "RGB"})
    elif name == "palette.png":
        Image.fromarray(RGBA[:, :, 0]).convert("P").save(path)
    else:
        Image.fromarray(RGBA[:, :, 0] if name == "grey.png" else RGBA[:, :, :3]).save(path)
    found = load_bitmap(d.Bitmap(file=str(path), channel="a"), "")
    assert found.shape[2] == 1
    assert (found == (1 if name == "a.exr" else 255)).all()


def test_channels_are_stored_once_and_alone(tmp_path):
    """Two parameters from two channels of one image take the memory of these two."""
    path = tmp_path / "a.png"
    path.write_bytes(png())
    atlas = TextureAtlas()
    for scale in (1.0, 0.5):
        for channel in "gb":
            atlas.add(d.Bitmap(file=str(path), channel=channel, scale=scale), "", scalar=True)
    assert len(atlas.records) == 4
    assert sum(part.size for part in atlas.pixels["bytes"]) == 2 * 3 * 5
    means = RGBA[:, :, 1:3].mean(axis=(0, 1)) / 255
    np.testing.assert_allclose([mean[0] for mean in atlas.means], [*means, *(0.5 * means)], rtol=1e-12)


def test_a_channel_is_a_number(tmp_path):
    """It is not decoded as colour, unless its record says so; alpha never is."""
    path = tmp_path / "a.png"
    path.write_bytes(png())
    atlas = TextureAtlas()
    for fields in (
        {},
        {"channel": "r"},
        {"channel": "r", "color_space": "srgb"},
        {"channel": "a", "color_space": "srgb"},
    ):
        atlas.add(d.Bitmap(file=str(path), **fields), "", scalar=False)
    assert [record["srgb"] for record in atlas.records] == [1, 0, 1, 0]


def test_samplers_and_external_images(builder, tmp_path):
    (tmp_path / "a b.png").write_bytes(png())
    image = builder.add("images", uri="a%20b.png")
    sampler = builder.add("samplers", magFilter=9728, wrapS=33071, wrapT=33071)
    texture = builder.add("textures", source=image, sampler=sampler)
    _, bsdf, warnings = load(builder, tmp_path, pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    assert bsdf.base_color == d.Bitmap(
        file=str(tmp_path / "a b.png"), color_space="srgb", filter="nearest", wrap="clamp"
    )
    assert warnings == []
    builder.tree["samplers"][0]["wrapT"] = 33648
    _, bsdf, warnings = load(builder, tmp_path, material=0)
    assert warnings == [
        "materials[0]: a texture that is wrapped differently along u and v (clamp and mirror) is wrapped as along u"
    ]


def test_texture_transform(builder, tmp_path):
    """The lower left quadrant of the image, turned by a quarter: the example of the extension."""
    info = {"index": builder.texture(png())}
    info["extensions"] = {"KHR_texture_transform": {"offset": [0, 1], "rotation": math.pi / 2, "scale": [0.5, 0.5]}}
    _, bsdf, _ = load(builder, tmp_path, pbrMetallicRoughness={"baseColorTexture": info})
    corners = np.array([(0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)])
    np.testing.assert_allclose(
        corners @ np.array(bsdf.base_color.uv_transform).T, [(0, 1), (0, 0.5), (0.5, 1), (0.5, 0.5)], atol=1e-15
    )
    # scale acts first, the offset last
    info["extensions"]["KHR_texture_transform"] = {"offset": [3, 4], "rotation": math.pi / 2, "scale": [2, 5]}
    builder.tree["materials"].clear()
    _, bsdf, _ = load(builder, tmp_path, pbrMetallicRoughness={"baseColorTexture": info})
    np.testing.assert_allclose(bsdf.base_color.uv_transform, [(0, 5, 3), (-2, 0, 4)], atol=1e-15)


def test_normal_textures(builder, tmp_path):
    """Around both sides, as seen from behind the same bumps are hollows; inside the mask."""
    normal = {"index": builder.texture(png()), "scale": 0.5}
    _, bsdf, warnings = load(
        builder, tmp_path, normalTexture=normal, doubleSided=True, alphaMode="BLEND",
        pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.5]},
    )  # fmt: skip
    image = d.Bitmap(file=str(tmp_path / "a.glb"), image=0, color_space="linear")
    around = d.NormalMap(bsdf=d.TwoSided(front=principled()), normal=image, scale=0.5)
    assert bsdf == d.Mask(name="material 0", bsdf=around, opacity=0.5)
    assert warnings == []


def test_sets_of_coordinates(builder, tmp_path):
    texture = builder.texture(png())
    pbr = {"baseColorTexture": {"index": texture, "texCoord": 1}}
    scene, _, _ = load(builder, tmp_path, pbrMetallicRoughness=pbr)
    assert scene.shapes[0].part == d.GltfPart(mesh=0, uv_set=1)
    transform = {"index": texture, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    builder.tree["materials"][0]["emissiveTexture"] = transform
    builder.tree["materials"][0]["emissiveFactor"] = [1, 1, 1]
    assert load(builder, tmp_path, material=0)[0].shapes[0].part.uv_set == 1
    transform["extensions"]["KHR_texture_transform"]["texCoord"] = 0
    with pytest.raises(SceneError) as caught:
        load(builder, tmp_path, material=0)
    assert caught.value.path == "materials[0]"
    assert "TEXCOORD_0 (emissiveTexture) and TEXCOORD_1 (baseColorTexture)" in caught.value.message


# --- extensions ------------------------------------------------------------------------------------------------


def test_index_of_refraction_and_specular(builder, tmp_path):
    def specular(**extensions):
        fields = {"extensions": {f"KHR_materials_{name}": value for name, value in extensions.items()}}
        return load(GltfBuilder(), tmp_path, **fields)[1:]

    bsdf, warnings = specular(ior={"ior": 1.5})
    assert (bsdf.specular, bsdf.eta, warnings) == (None, None, [])
    bsdf, warnings = specular(ior={"ior": 1.4})
    np.testing.assert_allclose(0.08 * bsdf.specular, (0.4 / 2.4) ** 2)
    bsdf, warnings = specular(specular={"specularFactor": 0.25})
    np.testing.assert_allclose(bsdf.specular, 0.125)
    assert (bsdf.eta, warnings) == (None, [])
    bsdf, warnings = specular(ior={"ior": 2.4}, specular={"specularColorFactor": [1, 0, 0]})
    assert bsdf.specular == 1.0
    assert any("is taken as 0.08" in text for text in warnings) and any("specularColorFactor" in t for t in warnings)
    with pytest.raises(SceneError, match=r"KHR_materials_ior.ior: expected 0 or a number of at least 1; found 0.5"):
        specular(ior={"ior": 0.5})


def test_glass(builder, tmp_path):
    def glass(transmission, **fields):
        extensions = {"KHR_materials_transmission": transmission, "KHR_materials_ior": {"ior": 1.3}}
        pbr = {"metallicFactor": 0, "roughnessFactor": 0, "baseColorFactor": [1, 0.5, 0.5, 1]} | fields.pop("pbr", {})
        extensions |= fields.pop("extensions", {})
        return load(GltfBuilder(), tmp_path, pbrMetallicRoughness=pbr, extensions=extensions, **fields)[1:]

    tint = [1.0, 0.5, 0.5]
    thin = d.ThinDielectric(name="material 0", int_ior=1.3, ext_ior=1.0, specular_transmittance=tint)
    assert glass({"transmissionFactor": 1}, doubleSided=True) == (thin, [])
    solid = principled(name="material 0", base_color=tint, metallic=0.0, roughness=0.0, spec_trans=1.0, eta=1.3)
    volume = {"KHR_materials_volume": {"thicknessFactor": 0.1}}
    assert glass({"transmissionFactor": 1}, doubleSided=True, extensions=volume) == (solid, [])
    volume["KHR_materials_volume"] |= {"attenuationDistance": 1, "attenuationColor": [1, 0, 0]}
    _, warnings = glass({"transmissionFactor": 1}, extensions=volume)
    assert warnings == ["materials[0]: the absorption of KHR_materials_volume is left out"]
    solid.spec_trans = 0.5
    bsdf, warnings = glass({"transmissionFactor": 0.5})
    assert bsdf == solid
    assert warnings == ["materials[0]: a thin wall that transmits in part is taken as the boundary of a solid"]
    bsdf, warnings = glass({"transmissionFactor": 1}, pbr={"roughnessFactor": 0.5})
    assert bsdf == thin
    assert warnings == ["materials[0]: the roughness of a thin wall that transmits is left out"]


def test_anisotropy(builder, tmp_path):
    """The two roughnesses are those of the extension: along the tangent mix(alpha, 1, s^2), across it alpha."""
    extension = {"KHR_materials_anisotropy": {"anisotropyStrength": 0.5}}
    _, bsdf, warnings = load(builder, tmp_path, pbrMetallicRoughness={"roughnessFactor": 0.6}, extensions=extension)
    aspect = math.sqrt(1 - 0.9 * bsdf.anisotropic)
    np.testing.assert_allclose(
        (bsdf.roughness**2 / aspect, bsdf.roughness**2 * aspect), (0.36 + 0.64 * 0.25, 0.36), rtol=1e-12
    )
    assert warnings == []
    extension["KHR_materials_anisotropy"]["anisotropyRotation"] = 1.0
    pbr = {"roughnessFactor": 0.1}
    extension["KHR_materials_anisotropy"]["anisotropyStrength"] = 1.0
    _, bsdf, warnings = load(GltfBuilder(), tmp_path, pbrMetallicRoughness=pbr, extensions=extension)
    assert bsdf.anisotropic == 1.0
    assert len(warnings) == 2


def test_clearcoat_and_sheen(builder, tmp_path):
    coat = {"clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.2}
    extensions = {"KHR_materials_clearcoat": coat, "KHR_materials_sheen": {"sheenColorFactor": [0.2, 0.4, 0.1]}}
    _, bsdf, warnings = load(builder, tmp_path, extensions=extensions)
    # the roughness of the coat is alpha = 0.04, as gloss interpolates it from 0.1 to 0.001
    np.testing.assert_allclose(0.1 + bsdf.clearcoat_gloss * (0.001 - 0.1), 0.04, rtol=1e-12)
    assert (bsdf.clearcoat, bsdf.sheen) == (0.5, 0.4)
    assert len(warnings) == 2


def test_unlit(builder, tmp_path):
    _, bsdf, warnings = load(builder, tmp_path, extensions={"KHR_materials_unlit": {}})
    assert bsdf == principled(name="material 0")
    assert warnings == ["materials[0]: KHR_materials_unlit has no place in light transport: taken as a lit material"]


# --- errors ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"index": 5}, "materials[0].pbrMetallicRoughness.baseColorTexture.index: index 5 is out of range"),
        ({"index": 1}, "textures[1].source: index 9 is out of range; images has 3"),
        ({"index": 2}, "textures[2]: has no source that is supported"),
        ({"index": 3}, "images[1]: has neither uri nor bufferView"),
        ({"index": 4}, "images[2]: is neither PNG nor JPEG"),
        ({"index": 0, "texCoord": 2}, "baseColorTexture.texCoord: expected an integer >= 0 and <= 1; found 2"),
        ({}, "materials[0].pbrMetallicRoughness.baseColorTexture: missing key 'index'"),
    ],
)
def test_errors(builder, tmp_path, fields, words):
    builder.texture(png())
    builder.add("textures", source=9)
    builder.add("textures")
    builder.add("textures", source=builder.add("images"))
    builder.texture(b"GIF89a")
    with pytest.raises(SceneError) as caught:
        load(builder, tmp_path, pbrMetallicRoughness={"baseColorTexture": fields})
    assert str(caught.value).startswith(f"{tmp_path / 'a.glb'}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_damaged_embedded_image(builder, tmp_path):
    builder.texture(png()[:40])
    path = builder.write(tmp_path / "a.glb")
    with pytest.raises(SceneError) as caught:
        load_bitmap(d.Bitmap(file=str(path), image=0), "textures[0].file")
    assert str(caught.value).startswith(f"textures[0].file: {path}: images[0]: cannot be read: ")
    with pytest.raises(SceneError, match=r"a.glb: index 7 is out of range; images has 1"):
        load_bitmap(d.Bitmap(file=str(path), image=7), "")
