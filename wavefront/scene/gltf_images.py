"""Images that lie inside a glTF file."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from wavefront.errors import SceneError
from wavefront.scene.gltf_document import open_document
from wavefront.scene.images import load_image


def embedded_image(file: str, index: int, where: str) -> tuple[bytes | memoryview, str]:
    """The bytes of image `index` of a glTF file and their suffix, .png or .jpg.

    Raises:
        SceneError: Damaged file, or no such image in it; its path is the record path `where`.
    """
    try:
        return open_document(file).image_bytes(index, "")
    except SceneError as error:
        raise SceneError(": ".join(filter(None, (str(file), error.path, error.message))), path=where) from None


def load_embedded(file: str, index: int, where: str, alpha: bool = False) -> np.ndarray:
    """Pixels of image `index` of a glTF file, as `images.load_image` gives and refuses them."""
    data, suffix = embedded_image(file, index, where)
    # through a file of its own, because not every image library reads from memory
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"image{suffix}"
        try:
            path.write_bytes(data)
        except OSError as error:
            raise SceneError(f"{path}: cannot be written: {error.strerror or error}", path=where) from None
        try:
            return load_image(path, where, alpha)
        except SceneError as error:
            raise SceneError(error.message.replace(str(path), f"{file}: images[{index}]"), path=where) from None
