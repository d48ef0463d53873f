"""Images: what is written is what is read, and errors are one line."""

import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from PIL import Image

from wavefront.errors import SceneError, WavefrontError
from wavefront.scene.images import load_image, write_exr, write_png


@pytest.fixture
def rgb():
    return np.random.default_rng(1).integers(0, 256, (5, 7, 3), np.uint8)


def only_file(folder, name):
    assert [path.name for path in folder.iterdir()] == [name]


def test_png_round_trip(tmp_path, rgb):
    write_png(tmp_path / "a.png", rgb)
    only_file(tmp_path, "a.png")
    np.testing.assert_array_equal(load_image(tmp_path / "a.png"), rgb)


def test_grey_png_has_one_channel(tmp_path, rgb):
    write_png(tmp_path / "a.png", rgb[:, :, 0])
    np.testing.assert_array_equal(load_image(tmp_path / "a.png"), rgb[:, :, :1])


def test_alpha_is_dropped_and_not_multiplied_in(tmp_path, rgb):
    alpha = np.full((5, 7, 1), 3, np.uint8)
    Image.fromarray(np.concatenate([rgb, alpha], axis=2)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(load_image(tmp_path / "a.png"), rgb)


def test_palette_is_expanded(tmp_path):
    image = Image.fromarray(np.array([[0, 1], [2, 1]], np.uint8)).convert("P")
    image.putpalette([255, 0, 0, 0, 255, 0, 1, 2, 3])
    image.save(tmp_path / "a.png")
    expected = [[(255, 0, 0), (0, 255, 0)], [(1, 2, 3), (0, 255, 0)]]
    np.testing.assert_array_equal(load_image(tmp_path / "a.png"), expected)


def write_oiio(path, pixels, kind):
    spec = OpenImageIO.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output = OpenImageIO.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(pixels)
    output.close()


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_16_bit_integers_are_kept(tmp_path, suffix, channels):
    """Every bit of every channel but alpha, which is not multiplied in."""
    values = np.random.default_rng(4).integers(0, 65536, (5, 3, channels), np.uint16)
    values[..., -1] //= 7
    write_oiio(tmp_path / f"a{suffix}", values, "uint16")
    pixels = load_image(tmp_path / f"a{suffix}")
    assert pixels.dtype == np.uint16
    np.testing.assert_array_equal(pixels, values[:, :, : 3 if channels >= 3 else 1])


def test_16_bit_grey_of_pillow(tmp_path):
    values = np.array([[0, 1, 65535], [256, 32768, 12345]], np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    np.testing.assert_array_equal(load_image(tmp_path / "a.png")[:, :, 0], values)


@pytest.mark.parametrize("kind", ["uint8", "float"])
def test_tiff(tmp_path, kind):
    values = (200 * np.random.default_rng(5).random((4, 6, 3))).astype(np.uint8 if kind == "uint8" else np.float32)
    write_oiio(tmp_path / "a.tiff", values, kind)
    pixels = load_image(tmp_path / "a.tiff")
    assert pixels.dtype == values.dtype
    np.testing.assert_array_equal(pixels, values)


@pytest.mark.parametrize("name", ["a.bmp", "a.tga"])
def test_other_8_bit_formats(tmp_path, rgb, name):
    Image.fromarray(rgb).save(tmp_path / name)
    np.testing.assert_array_equal(load_image(tmp_path / name), rgb)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_truncated_16_bit_files(tmp_path, name):
    write_oiio(tmp_path / name, np.random.default_rng(6).integers(0, 65536, (64, 64, 3), np.uint16), "uint16")
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(SceneError, match="cannot be read") as caught:
        load_image(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_five_channels_are_refused(tmp_path):
    write_oiio(tmp_path / "a.tif", np.zeros((2, 2, 5), np.uint8), "uint8")
    with pytest.raises(SceneError, match="has 5 channels"):
        load_image(tmp_path / "a.tif")


def test_exr_of_halves_and_floats_becomes_floats(tmp_path):
    values = np.full((2, 2), 0.1)
    planes = {"R": values.astype(np.float16), "G": values.astype(np.float32), "B": values.astype(np.float16)}
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, dict(planes)) as file:
        file.write(str(tmp_path / "a.exr"))
    pixels = load_image(tmp_path / "a.exr")
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels[0, 0], [planes[c][0, 0] for c in "RGB"])


def test_jpeg(tmp_path):
    Image.fromarray(np.full((8, 8, 3), 100, np.uint8)).save(tmp_path / "a.jpg", quality=95)
    pixels = load_image(tmp_path / "a.jpg")
    assert pixels.shape == (8, 8, 3)
    assert np.abs(pixels.astype(int) - 100).max() <= 2


@pytest.mark.parametrize("half", [False, True])
def test_exr_round_trip(tmp_path, half):
    values = np.random.default_rng(2).uniform(-3.0, 60000.0, (3, 4, 5)).astype(np.float32)
    names = ["R", "G", "B"]
    write_exr(tmp_path / "a.exr", dict(zip(names, values, strict=True)), half=half)
    only_file(tmp_path, "a.exr")
    pixels = load_image(tmp_path / "a.exr")
    expected = values.astype(np.float16) if half else values
    assert pixels.dtype == expected.dtype
    np.testing.assert_array_equal(pixels, np.moveaxis(expected, 0, 2))


def test_exr_keeps_channel_names_and_type(tmp_path):
    channels = {name: np.full((2, 2), i, np.float32) for i, name in enumerate(["R", "G", "B", "albedo.R", "depth.Z"])}
    write_exr(tmp_path / "a.exr", channels)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        found = {name: channel.pixels for name, channel in file.channels().items()}
    assert set(found) == set(channels)
    for name, pixels in channels.items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], pixels)


def test_exr_keeps_large_values_and_infinity(tmp_path):
    values = np.array([[1e30, np.inf], [-1e-30, 0.0]], np.float32)
    write_exr(tmp_path / "a.exr", {"Y": values})
    np.testing.assert_array_equal(load_image(tmp_path / "a.exr")[:, :, 0], values)


def test_half_overflow_is_an_error_and_writes_nothing(tmp_path):
    write_exr(tmp_path / "ok.exr", {"Y": np.full((1, 1), 65504.0)}, half=True)
    for value in (65505.0, -70000.0):
        with pytest.raises(WavefrontError, match="half precision ends at 65504"):
            write_exr(tmp_path / "bad.exr", {"Y": np.full((1, 1), value)}, half=True)
    only_file(tmp_path, "ok.exr")


def test_channels_of_different_shapes_are_refused(tmp_path):
    with pytest.raises(WavefrontError, match="one shape"):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2)), "G": np.zeros((2, 3))})
    with pytest.raises(WavefrontError, match="uint8"):
        write_png(tmp_path / "a.png", np.zeros((2, 2, 3)))


@pytest.mark.parametrize("name", ["a.png", "a.exr"])
def test_unwritable_folder(tmp_path, name):
    path = tmp_path / "missing" / name
    write, pixels = (write_png, np.zeros((2, 2), np.uint8)) if name == "a.png" else (write_exr, {"Y": np.zeros((2, 2))})
    with pytest.raises(WavefrontError, match="cannot be written"):
        write(path, pixels)


@pytest.mark.parametrize("name", ["a.png", "a.exr", "a.jpg"])
def test_missing_and_damaged_files(tmp_path, name):
    path = tmp_path / name
    with pytest.raises(SceneError, match=rf"^textures\[0\]\.file: .*{name}: file not found$"):
        load_image(path, "textures[0].file")
    path.write_bytes(b"this is not an image")
    with pytest.raises(SceneError, match="cannot be read") as caught:
        load_image(path, "w")
    assert "\n" not in str(caught.value)


def test_truncated_png(tmp_path, rgb):
    write_png(tmp_path / "a.png", np.tile(rgb, (20, 20, 1)))
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(SceneError, match="cannot be read"):
        load_image(tmp_path / "a.png")


def test_exr_without_colours(tmp_path):
    write_exr(tmp_path / "a.exr", {"u": np.zeros((2, 2)), "v": np.zeros((2, 2))})
    with pytest.raises(SceneError, match="has channels u, v; needed: R, G, B"):
        load_image(tmp_path / "a.exr")
