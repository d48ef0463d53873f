"""Textures on the device: in the type and channels of their files, each file once, and what is said about UVs."""

import mitsuba as mi
import numpy as np
import OpenImageIO
import pytest
import warp as wp
from PIL import Image

from tests.test_texture import look_up
from wavefront import Renderer
from wavefront.errors import SceneError
from wavefront.scene import description as d
from wavefront.scene.device import upload_scene
from wavefront.scene.images import write_exr
from wavefront.scene.texture_upload import TextureAtlas
from wavefront.texture import IMAGE_TYPES, TextureRecord

RNG = np.random.default_rng(3)
SHAPE = 40, 60


def write_file(path, channels):
    """A file of the kind that the name says, and the bytes its pixels take uncompressed, alpha apart."""
    kind, _, suffix = path.name.partition(".")
    if kind in ("half", "float"):
        values = RNG.random((*SHAPE, channels))
        names = "RGB" if channels == 3 else "Y"
        write_exr(path, {c: values[:, :, i] for i, c in enumerate(names)}, half=kind == "half")
        return values.size * (2 if kind == "half" else 4)
    if suffix == "hdr":
        header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {SHAPE[0]} +X {SHAPE[1]}\n".encode()
        pixels = RNG.integers(128, 138, (*SHAPE, 4), np.uint8)
        path.write_bytes(header + pixels.tobytes())
        return SHAPE[0] * SHAPE[1] * 3 * 2  # of 4 in the file
    dtype = np.uint16 if kind == "short" else np.uint8
    values = RNG.integers(0, np.iinfo(dtype).max, (*SHAPE, channels), dtype)
    output = OpenImageIO.ImageOutput.create(str(path))
    assert output.open(str(path), OpenImageIO.ImageSpec(SHAPE[1], SHAPE[0], channels, dtype.__name__))
    assert output.write_image(values)
    output.close()
    return values.nbytes


def device_bytes(tables):
    """Of the pixels, by kind, and of all else but the tables of sRGB."""
    pixels = {kind: getattr(tables, kind).capacity for kind in IMAGE_TYPES if getattr(tables, kind) is not None}
    return {kind: size for kind, size in pixels.items() if size}, tables.records.capacity


def textured(*textures):
    return d.Scene(shapes=[d.Rectangle(bsdf=d.Diffuse(reflectance=texture)) for texture in textures])


@pytest.mark.parametrize(
    ("name", "channels", "kind"),
    [
        ("byte.png", 3, "bytes"),
        ("byte.png", 1, "bytes"),
        ("byte.jpg", 3, "bytes"),
        ("byte.tif", 1, "bytes"),
        ("short.png", 3, "shorts"),
        ("short.png", 1, "shorts"),
        ("short.tif", 3, "shorts"),
        ("half.exr", 3, "halves"),
        ("half.exr", 1, "halves"),
        ("float.exr", 3, "floats"),
        ("float.exr", 1, "floats"),
        ("radiance.hdr", 3, "halves"),
    ],
)
def test_memory_is_that_of_the_file(tmp_path, name, channels, kind):
    size = write_file(tmp_path / name, channels)
    tables = upload_scene(textured(d.Bitmap(file=str(tmp_path / name))), "cpu").textures
    pixels, records = device_bytes(tables)
    assert pixels == {kind: size}
    assert records == wp.types.type_size_in_bytes(TextureRecord)
    table = {"bytes": "srgb_to_linear", "shorts": "srgb16_to_linear"}
    for other, field in table.items():
        assert (getattr(tables, field) is not None and getattr(tables, field).size > 0) == (other == kind)


def test_a_file_is_stored_once(tmp_path):
    """However it is looked up; floats that are decoded are another image."""
    sizes = {name: write_file(tmp_path / name, 3) for name in ("byte.png", "float.exr")}
    uses = [{}, {"wrap": "clamp"}, {"scale": 2.0}, {"color_space": "linear"}, {"color_space": "srgb"}]
    bitmaps = [d.Bitmap(file=str(tmp_path / name), **use) for name in sizes for use in uses]
    device_scene = upload_scene(textured(*bitmaps), "cpu")
    pixels, _ = device_bytes(device_scene.textures)
    assert pixels == {"bytes": sizes["byte.png"], "floats": 2 * sizes["float.exr"]}
    assert len(device_scene.textures.records) == 10


def test_kinds_are_compiled_where_they_are_present(tmp_path):
    write_file(tmp_path / "short.png", 3)
    write_file(tmp_path / "half.exr", 3)
    both = textured(d.Bitmap(file=str(tmp_path / "short.png")), d.Bitmap(file=str(tmp_path / "half.exr")))
    assert upload_scene(both, "cpu").texture_kinds == ("halves", "shorts")


@pytest.mark.parametrize("name", ["byte.png", "short.png", "half.exr", "float.exr"])
@pytest.mark.parametrize("channels", [1, 3])
def test_means(tmp_path, name, channels):
    """By which lights are selected: the mean of the linear values, times the scale."""
    write_file(tmp_path / name, channels)
    for space in ("linear", "srgb"):
        atlas = TextureAtlas()
        index = atlas.add(
            d.Bitmap(file=str(tmp_path / name), color_space=space, scale=3.0, filter="nearest"), "", False
        )
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
        uv = np.stack([(x + 0.5) / SHAPE[1], (y + 0.5) / SHAPE[0]], axis=-1).reshape(-1, 2)
        pixels = look_up_all(atlas.upload("cpu"), index, uv)
        np.testing.assert_allclose(atlas.means[index], pixels.mean(axis=0, dtype=np.float64), rtol=1e-5)


def look_up_all(tables, texture, uv):
    """With the kernel of all kinds, which wants every array."""
    for kind, dtype in IMAGE_TYPES.items():
        if getattr(tables, kind) is None:
            setattr(tables, kind, wp.array(np.zeros(1, dtype), device="cpu"))
    return look_up(tables, texture, uv)


@pytest.mark.parametrize("name", ["byte.png", "short.png", "half.exr", "float.exr"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("raw", [False, True])
def test_values_are_mitsubas(tmp_path, name, channels, raw):
    """Mitsuba keeps 8-bit and 16-bit textures as halves: within their rounding."""
    write_file(tmp_path / name, channels)
    mi.set_variant("scalar_rgb")
    peer = mi.load_dict({"type": "bitmap", "filename": str(tmp_path / name), "raw": raw, "filter_type": "nearest"})
    atlas = TextureAtlas()
    texture = d.Bitmap(file=str(tmp_path / name), color_space="linear" if raw else "auto", filter="nearest")
    index = atlas.add(texture, "", False)
    uv = RNG.random((50, 2)).astype(np.float32)
    ours = look_up_all(atlas.upload("cpu"), index, uv)
    for value, at in zip(ours, uv, strict=True):
        si = mi.SurfaceInteraction3f()
        si.uv = mi.Point2f(float(at[0]), float(at[1]))
        np.testing.assert_allclose(value, np.array(peer.eval(si)).ravel(), rtol=2e-3, atol=2e-4)


# --- UVs -----------------------------------------------------------------------------------------------------------

TRIANGLE = {"vertices": [(-9.0, -9.0, 0.0), (9.0, -9.0, 0.0), (0.0, 9.0, 0.0)], "faces": [(0, 1, 2)]}


@pytest.fixture
def picture(tmp_path):
    pixels = np.array([[255, 128], [64, 0]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    return d.Bitmap(file=str(tmp_path / "a.png"), filter="nearest", color_space="linear")


@pytest.mark.parametrize("where", ["bsdf", "mask", "emitter"])
def test_textures_without_uvs(picture, where):
    """They are looked up at (0, 0), and a note names the shape."""
    fields = {
        "bsdf": {"bsdf": d.TwoSided(front=d.Diffuse(reflectance=picture))},
        "mask": {"bsdf": d.Mask(bsdf=d.Diffuse(reflectance=1.0), opacity=picture)},
        "emitter": {"bsdf": d.Diffuse(reflectance=0.0), "emitter": d.Area(radiance=picture)},
    }
    shapes = [d.Mesh(name="flag", **TRIANGLE, **fields[where]), d.Mesh(**TRIANGLE)]
    shapes.append(d.Mesh(**TRIANGLE, uvs=[(0, 0)] * 3, **fields[where]))
    notes = upload_scene(d.Scene(shapes=shapes), "cpu").notes
    assert notes == ["shapes[0] ('flag') has no UVs: its textures are looked up at (0, 0)"]


def test_a_texture_without_uvs_is_its_first_pixel(picture):
    camera = d.Perspective(fov=20.0, to_world=[d.TransformStep(translate=(0.0, 0.0, 3.0))])
    shape = d.Mesh(**TRIANGLE, bsdf=d.Diffuse(reflectance=0.0), emitter=d.Area(radiance=picture))
    scene = d.Scene(shapes=[shape], camera=camera, film=d.Film(width=4, height=4))
    scene.integrator = d.PathIntegrator(max_depth=1)
    np.testing.assert_allclose(Renderer(scene, threads=1).render(1), 1.0, rtol=1e-6)


def test_pixels_that_are_not_finite(tmp_path):
    values = np.ones((3, 4))
    values[2, 1] = np.nan
    write_exr(tmp_path / "a.exr", {"Y": values}, half=True)
    with pytest.raises(SceneError, match=r"pixel \(1, 2\) is not finite"):
        upload_scene(textured(d.Bitmap(file=str(tmp_path / "a.exr"))), "cpu")
