"""A scene that requires everything, yet looks the same: the worst case of kernels that are built for a scene."""

from __future__ import annotations

import msgspec
import numpy as np

from tools.bench_common import ROOT
from wavefront.scene import description, load_scene
from wavefront.scene.lookup import BSDF_FIELDS, TEXTURE_FIELDS, resolve_bsdf, resolve_texture
from wavefront.scene.transforms import to_matrix

FAINT = 1e-20  # radiance of what is added
ENVIRONMENTS = (description.Constant, description.Envmap, description.SunSky)  # of which a scene has one


def with_every_feature(scene: description.Scene) -> description.Scene:
    """The scene with every BSDF, texture and kind of light of this repository's own scenes, out of sight.

    Each is put on a triangle or sphere a ten-thousandth as large as the camera is far from the origin, behind the
    camera; lights are so faint that they are never chosen. Kernels are built for all of it, rays hardly ever meet it.

    Args:
        scene: Valid records; the shapes and emitters are added to.
    """
    matrix = to_matrix(scene.camera.to_world)
    camera, back = matrix[:3, 3], matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    size = 1e-4 * max(float(np.linalg.norm(camera)), 1e-3)
    corners = camera + size * (5.0 * back + np.eye(3))
    emitters: dict[type, description.Emitter] = {type(emitter): emitter for emitter in scene.emitters}
    environment = any(isinstance(emitter, ENVIRONMENTS) for emitter in scene.emitters)
    blend = description.Blend(first=description.Dielectric(), second=description.Diffuse())
    scene.shapes.append(_triangle(corners, blend, None))  # of which there is no scene
    scene.shapes[-1].interior = description.Homogeneous(sigma_a=1.0)
    inside = [_triangle(corners, None, None), description.Sphere(center=tuple(corners[0]), radius=size)]
    scene.groups.append(description.Group(name="every feature", shapes=inside))
    scene.instances.append(description.Instance(group="every feature"))
    for file in sorted((ROOT / "scenes").glob("*.json")):
        donor = load_scene(file)
        for shape in donor.shapes:
            if shape.bsdf is not None or shape.emitter is not None:
                bsdf = _inlined(donor, resolve_bsdf(donor, shape.bsdf))
                emitter = shape.emitter and _faint(shape.emitter)
                if isinstance(shape, description.Sphere):
                    added = description.Sphere(center=tuple(corners[0]), radius=size, bsdf=bsdf, emitter=emitter)
                else:
                    added = _triangle(corners, bsdf, emitter)
                scene.shapes.append(added)
        for emitter in donor.emitters:
            surroundings = isinstance(emitter, ENVIRONMENTS)
            if type(emitter) not in emitters and not (surroundings and environment):
                environment |= surroundings
                emitters[type(emitter)] = emitter
                scene.emitters.append(_faint(emitter))
    return scene


def _triangle(corners, bsdf, emitter):
    return description.Mesh(
        vertices=[tuple(map(float, corner)) for corner in corners],
        faces=[(0, 1, 2)],
        normals=[(0.0, 0.6, 0.8)] * 3,
        uvs=[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)],
        bsdf=bsdf,
        emitter=emitter,
    )


def _faint(emitter):
    """The emitter with every radiance, irradiance, intensity and scale next to nothing."""
    changes = {}
    for name in ("radiance", "irradiance", "intensity", "scale"):
        if getattr(emitter, name, None) is not None:
            changes[name] = FAINT
    return msgspec.structs.replace(emitter, **changes)


def _inlined(donor: description.Scene, record):
    """A record with the records that it names in the place of their names."""
    changes = {}
    for name in record.__struct_fields__:
        value = getattr(record, name)
        if name in TEXTURE_FIELDS:
            changes[name] = resolve_texture(donor, value)
        elif name in BSDF_FIELDS and value is not None:
            changes[name] = _inlined(donor, resolve_bsdf(donor, value))
    return msgspec.structs.replace(record, name="", **changes)
