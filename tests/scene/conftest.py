"""Small scenes in the format of Mitsuba, for tests of its importer."""

import numpy as np
import pytest
from PIL import Image

from wavefront.scene import mitsuba

SENSOR = '<sensor type="perspective"/>'
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0.1 0.2\nvt 0.9 0.2\nvt 0.9 0.8\n"


@pytest.fixture(scope="module")
def mi():
    module = pytest.importorskip("mitsuba")
    module.set_variant("scalar_rgb")
    return module


@pytest.fixture
def xml_folder(tmp_path):
    (tmp_path / "flat.obj").write_text(OBJ + "f 1/1 2/2 3/3\n")
    (tmp_path / "normals.obj").write_text(OBJ + "vn 0 0 1\nf 1/1/1 2/2/1 3/3/1\n")
    (tmp_path / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "property float u\nproperty float v\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 .1 .2\n1 0 0 .9 .2\n1 1 0 .9 .8\n3 0 1 2\n"
    )
    (tmp_path / "bent.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 2\nv -1 0 1\nf 1 2 3\nf 1 3 4\nf 1 4 5\n")
    pixels = np.random.default_rng(4).integers(0, 256, (4, 8, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "colours.png")
    return tmp_path


@pytest.fixture
def load_xml(xml_folder):
    """Loads a scene whose elements start in line 2. Warnings are collected in `load_xml.warnings`."""

    def load_xml(body, version="3.0.0", sensor=True, parameters=None):
        path = xml_folder / "scene.xml"
        path.write_text(f'<scene version="{version}">\n{body}\n{SENSOR if sensor else ""}\n</scene>\n')
        load_xml.warnings = []
        return mitsuba.load(path, load_xml.warnings.append, parameters)

    return load_xml
