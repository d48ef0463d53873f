"""What a scene and its settings require: the frozen key that kernels are built for.

Every stage takes only the parts it reads, so that scenes which differ elsewhere share its compiled kernel.
"""

from __future__ import annotations

import dataclasses

from wavefront.bsdf.tables import BLENDS, DELTA
from wavefront.light import tables


@dataclasses.dataclass(frozen=True)
class Features:
    # Geometry
    triangles: bool  # some shape is a mesh
    spheres: bool
    instances: tuple[str, ...]  # kinds of primitive in groups that have instances, sorted; empty without instances
    accel: str  # how rays find triangles, one of `accel.intersector.ACCELS`
    streams: bool  # rays are traced by queues, see `accel.stream`
    ahead: bool  # what vertices are made of and their textures are fetched ahead, see `stages.ahead`
    smooth: bool  # some mesh has vertex normals
    uvs: bool  # some texture is looked up, or UVs are asked for
    tangents: bool  # some BSDF depends on the direction of its tangent

    # Materials
    bsdfs: tuple[str, ...]  # kinds, sorted
    maps: tuple[str, ...]  # kinds of map that turn shading frames, sorted: bump, normal
    mask: bool  # some material is not opaque
    media: bool  # some medium absorbs
    textures: tuple[str, ...]  # kinds, sorted

    # Lights
    lights: tuple[str, ...]  # kinds, sorted; empty if nothing emits
    light_textures: tuple[str, ...]  # kinds of texture that emitters have

    # Integrator, camera and film
    nee: bool
    roulette: bool
    sampler: str
    camera: str
    filter: str
    aovs: tuple[str, ...]  # arrays of the film that the first hit adds to, sorted
    variance: bool

    # Path guiding
    guide: tuple = ()  # name of the guide, and what tells its kernels from others of that name; empty without a guide
    guide_pdf: bool = True  # the guide has a density
    guide_inputs: tuple[str, ...] = ()  # what the guide asks to know of surfaces, see `wavefront.proposals`
    records: tuple[str, ...] = ()  # fields of the records that the guide trains with; empty if it asks for none
    weighted: bool = False  # samples have weights of the guide

    @property
    def guided(self) -> bool:
        return bool(self.guide)

    @property
    def transmission(self) -> bool:
        """Whether a path can cross into another medium, so that radiance scales with the index of refraction."""
        return any(kind in self.bsdfs for kind in ("dielectric", "rough_dielectric", "principled_transmissive"))

    @property
    def mixed_deltas(self) -> bool:
        """Whether a surface may have both delta directions and others."""
        return self.mask or any(kind in self.bsdfs for kind in ("plastic", *BLENDS))

    @property
    def smooth_bsdfs(self) -> bool:
        """Whether a light sample can contribute anywhere."""
        return any(kind not in (*DELTA, *BLENDS) for kind in self.bsdfs)

    @property
    def escape_lights(self) -> tuple[str, ...]:
        """Kinds of light that a ray finds which hits nothing."""
        return tuple(kind for kind in self.lights if kind in (*tables.ENVIRONMENT, "sun"))

    @property
    def area_lights(self) -> bool:
        return any(kind in tables.AREA for kind in self.lights)

    @property
    def light_sampling(self) -> bool:
        """Whether the direct-light and shadow stages exist."""
        return self.nee and bool(self.lights) and self.smooth_bsdfs
