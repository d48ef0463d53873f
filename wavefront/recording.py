"""Records: what paths found at their vertices, for a guide to learn from.

While a guide trains, a pass is one sample per pixel, and every `stride`-th path of it is written down as it is traced:
at each vertex the local weight of the scattering and the radiance that was added there. When the pass is done the
radiance that arrived at every vertex follows by the recursion from the last vertex to the first; nothing is divided by
a throughput, so that no channel is lost where a throughput vanished. A path has its own row for this, which belongs to
its pixel; so records and their order, by pixel and then by depth, do not depend on threads, tiles or devices.

Let a path have the segments 0 (from the camera), 1, 2, ...; segment l ends at vertex l, which scatters into segment
l + 1 with the weight w_l = f |cos| / p and survives Russian roulette with probability q_l. With T_l the transmittance
of a segment, E_l the emission at its end (by its weight against light sampling) and D_l the light sampled at vertex l,

    Li_l = T_l (E_l + D_l + (w_l / q_l) Li_(l+1))

is an estimate of the radiance that arrives along segment l, Li_0 being what the film gets.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import warp as wp

from wavefront.queues import SAMPLE_COUNT, TILE_WIDTH, TILE_X, TILE_Y
from wavefront.stage_kernel import stage_kernel

# Fields that a guide may ask for, by type: one value per record.
FIELDS = {
    "position": wp.vec3,
    "wo": wp.vec3,
    "normal": wp.vec3,
    "wi": wp.vec3,
    "pdf": wp.float32,
    "guide_pdf": wp.float32,
    "bsdf_pdf": wp.float32,
    "roughness": wp.float32,
    "transmits": wp.int32,
    "weight": wp.vec3,
    "survival": wp.float32,
    "radiance": wp.vec3,
    "taken": wp.vec3,
    "pixel": wp.int32,
    "depth": wp.int32,
}
_KEPT = ("pdf", "weight", "survival")  # fields that the recursion needs, asked for or not
_DERIVED = ("radiance", "pixel", "depth")  # fields that are not written down while paths are traced
_PER_SEGMENT = ("arrival", "through", "taken")


@dataclasses.dataclass(frozen=True)
class RecordRequest:
    """What a guide wants of every vertex.

    Attributes:
        fields: Keys of `FIELDS`; see `Records` for their meaning.
        depth: Scatterings of a path that are recorded, counted from the camera. What paths find further on is in the
            radiance of the last.
        memory: Bytes for the paths of a pass; where they would take more, every k-th path is recorded, with the
            smallest k that fits, and another k-th in every pass.
    """

    fields: tuple[str, ...]
    depth: int = 16
    memory: int = 256 << 20


@wp.struct
class Rows:
    """Paths that are recorded, while they are traced: row r of level l is entry l * count + r of an array.

    Arrays of scatterings have `depth` levels, arrays of segments one more. Paths that scatter more often add to the
    last segment what they find, times `through`, which goes on as the throughput from there.
    """

    count: wp.int32  # rows
    stride: wp.int32  # pixels from row to row
    depth: wp.int32
    film_width: wp.int32
    first: wp.array[wp.int32]  # one entry: the pixel of row 0 in this pass; -1: nothing is recorded

    scatterings: wp.array[wp.int32]  # of each row, so far
    # By segment.
    arrival: wp.array[wp.vec3]  # T (E + D)
    through: wp.array[wp.vec3]  # T
    taken: wp.array[wp.vec3]  # T times the emission that its weight took away
    # By scattering, see `Records`.
    position: wp.array[wp.vec3]
    wo: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    wi: wp.array[wp.vec3]
    pdf: wp.array[wp.float32]
    guide_pdf: wp.array[wp.float32]
    bsdf_pdf: wp.array[wp.float32]
    roughness: wp.array[wp.float32]
    transmits: wp.array[wp.int32]
    weight: wp.array[wp.vec3]
    survival: wp.array[wp.float32]


@wp.struct
class RecordScratch:
    """What a worker's stages leave for each other while paths are recorded, one entry per slot."""

    beta: wp.array[wp.vec3]  # throughput, put aside
    emission: wp.array[wp.vec3]  # of the vertex, seen from the last one, weighted
    whole_emission: wp.array[wp.vec3]  # the same without the weight; allocated if the difference is asked for
    no_pdf: wp.array[wp.float32]  # zeros; allocated as `whole_emission`
    light: wp.array[wp.vec3]  # light sample without the throughput; allocated if lights are sampled
    visible: wp.array[wp.vec3]  # light sample with the throughput if nothing is in between; allocated as `light`


@wp.struct
class RecordArrays:
    """Output of `gather`."""

    position: wp.array[wp.vec3]
    wo: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    wi: wp.array[wp.vec3]
    pdf: wp.array[wp.float32]
    guide_pdf: wp.array[wp.float32]
    bsdf_pdf: wp.array[wp.float32]
    roughness: wp.array[wp.float32]
    transmits: wp.array[wp.int32]
    weight: wp.array[wp.vec3]
    survival: wp.array[wp.float32]
    radiance: wp.array[wp.vec3]
    taken: wp.array[wp.vec3]
    pixel: wp.array[wp.int32]
    depth: wp.array[wp.int32]


@dataclasses.dataclass(frozen=True)
class Records:
    """Vertices of a pass at which a direction with a density was chosen, ordered by pixel and depth.

    Arrays are on the renderer's device, have `count` entries, belong to the renderer and are overwritten by the next
    pass; None if the field was not asked for. World space, metres, linear Rec. 709.

    Attributes:
        count: Records.
        path_count: Paths that were recorded, also those without a record.
        position: vec3.
        wo: vec3, unit length: towards the viewer.
        normal: vec3: shading normal, after bump or normal maps.
        wi: vec3, unit length: the direction that was chosen.
        pdf: float32, in solid angle: of `wi`, the density of the mixture of techniques; of a guide without a density,
            that of the BSDF (see `proposals.make_scatter_pdf`).
        guide_pdf: float32: density of the guide at `wi`, zero where the guide had no say. Of a guide without a density,
            the weight of its contribution where it proposed `wi`, else zero.
        bsdf_pdf: float32: density of BSDF sampling at `wi`.
        roughness: float32, in [0, 1]: see `wavefront.bsdf.roughness`.
        transmits: int32: 1 if light comes from both sides of the surface.
        weight: vec3: f |cos| / p, as it went into the throughput, without Russian roulette.
        survival: float32: probability with which Russian roulette let the path go on; 1 without. Paths that it ended
            leave no record of the vertex: a sum over records that shall not depend on roulette divides by this.
        radiance: vec3: estimate of the radiance that arrives along `wi`, in which emission that light sampling could
            have found too counts by its weight against light sampling.
        taken: vec3: what these weights took from the emission at the end of the next segment. `radiance` + `taken` is
            an estimate of all radiance that arrives along `wi`. Zero without light sampling.
        pixel: int32: of the film, row by row.
        depth: int32: scatterings of the path before this one.
        camera: vec3 [path_count]: radiance of each path, as the film gets it, up to roundings.
    """

    count: int
    path_count: int
    camera: wp.array
    position: wp.array | None = None
    wo: wp.array | None = None
    normal: wp.array | None = None
    wi: wp.array | None = None
    pdf: wp.array | None = None
    guide_pdf: wp.array | None = None
    bsdf_pdf: wp.array | None = None
    roughness: wp.array | None = None
    transmits: wp.array | None = None
    weight: wp.array | None = None
    survival: wp.array | None = None
    radiance: wp.array | None = None
    taken: wp.array | None = None
    pixel: wp.array | None = None
    depth: wp.array | None = None


# --- on the device ---------------------------------------------------------------------------------------------------


@wp.func
def record_row(rows: Rows, tile: wp.array[wp.int32], slot: int) -> int:
    """The row of a slot's path; -1 if it is not recorded. In a pass that is, a tile has one sample per pixel."""
    first = rows.first[0]
    if first < 0:
        return -1
    local = slot // tile[SAMPLE_COUNT]
    x = tile[TILE_X] + local % tile[TILE_WIDTH]
    y = tile[TILE_Y] + local // tile[TILE_WIDTH]
    distance = y * rows.film_width + x - first
    if distance < 0 or distance % rows.stride != 0:
        return -1
    return distance // rows.stride


@functools.cache
def make_gather(fields: tuple[str, ...]):
    """Kernels that turn rows into records.

    Args:
        fields: Field `records` of `Features`.

    Returns:
        `sum_radiance(rows, counts)`, which replaces `arrival` by the radiance along each segment and counts the
        records of each row, and `gather_records(rows, offsets, out)`; both have one thread per row.
    """

    @wp.func
    def usable(rows: Rows, entry: int) -> bool:
        """Whether the scattering of this entry makes a record."""
        return rows.pdf[entry] > 0.0 and wp.isfinite(rows.arrival[entry + rows.count])

    @stage_kernel
    def sum_radiance(
        # in and out
        rows: Rows,
        # out
        counts: wp.array[wp.int32],
    ):
        row = wp.tid()
        n = rows.scatterings[row]
        records = int(0)
        L = rows.arrival[n * rows.count + row]
        for k in range(n):
            entry = (n - 1 - k) * rows.count + row
            rows.arrival[entry + rows.count] = L
            if usable(rows, entry):
                records += 1
            local = rows.weight[entry] / rows.survival[entry]
            L = rows.arrival[entry] + wp.cw_mul(rows.through[entry], wp.cw_mul(local, L))
        rows.arrival[row] = L
        counts[row] = records

    @stage_kernel
    def gather_records(
        rows: Rows,
        offsets: wp.array[wp.int32],
        # out
        out: RecordArrays,
    ):
        row = wp.tid()
        index = offsets[row]
        for depth in range(rows.scatterings[row]):
            entry = depth * rows.count + row
            if usable(rows, entry):
                if wp.static("position" in fields):
                    out.position[index] = rows.position[entry]
                if wp.static("wo" in fields):
                    out.wo[index] = rows.wo[entry]
                if wp.static("normal" in fields):
                    out.normal[index] = rows.normal[entry]
                if wp.static("wi" in fields):
                    out.wi[index] = rows.wi[entry]
                if wp.static("pdf" in fields):
                    out.pdf[index] = rows.pdf[entry]
                if wp.static("guide_pdf" in fields):
                    out.guide_pdf[index] = rows.guide_pdf[entry]
                if wp.static("bsdf_pdf" in fields):
                    out.bsdf_pdf[index] = rows.bsdf_pdf[entry]
                if wp.static("roughness" in fields):
                    out.roughness[index] = rows.roughness[entry]
                if wp.static("transmits" in fields):
                    out.transmits[index] = rows.transmits[entry]
                if wp.static("weight" in fields):
                    out.weight[index] = rows.weight[entry]
                if wp.static("survival" in fields):
                    out.survival[index] = rows.survival[entry]
                if wp.static("radiance" in fields):
                    out.radiance[index] = rows.arrival[entry + rows.count]
                if wp.static("taken" in fields):
                    out.taken[index] = rows.taken[entry + rows.count]
                if wp.static("pixel" in fields):
                    out.pixel[index] = rows.first[0] + row * rows.stride
                if wp.static("depth" in fields):
                    out.depth[index] = depth
                index += 1

    return sum_radiance, gather_records


# --- on the host -----------------------------------------------------------------------------------------------------


def _kept(fields: tuple[str, ...]) -> dict[str, int]:
    """Arrays of `Rows` that are allocated, and by how much they have more levels than scatterings."""
    scattered = [name for name in FIELDS if name in (*fields, *_KEPT) and name not in (*_DERIVED, "taken")]
    segments = [name for name in _PER_SEGMENT if name != "taken" or "taken" in fields]
    return dict.fromkeys(scattered, 0) | dict.fromkeys(segments, 1)


def _row_bytes(fields: tuple[str, ...], depth: int) -> int:
    """Memory of one row, and of as many records as it can become."""
    size = wp.types.type_size_in_bytes
    rows = sum((depth + more) * size(Rows.vars[name].type.dtype) for name, more in _kept(fields).items())
    return rows + 3 * 4 + depth * sum(size(FIELDS[name]) for name in fields)


class Recorder:
    """The rows of a pass and the records they become.

    Args:
        request: What the guide asks for.
        max_depth: Of the integrator: segments of the longest path.
        width, height: Of the film that the passes cover, pixels.
        device: Warp device.
    """

    def __init__(self, request: RecordRequest, max_depth: int, width: int, height: int, device: str):
        self.fields, self.device = request.fields, device
        pixels = width * height
        depth = max(1, min(request.depth, max_depth - 1))
        self.stride = min(pixels, max(1, math.ceil(pixels * _row_bytes(self.fields, depth) / request.memory)))
        count = math.ceil(pixels / self.stride)
        self.nbytes = count * _row_bytes(self.fields, depth)
        self.pixels, self.rows = pixels, Rows()
        rows = self.rows
        rows.count, rows.stride, rows.depth, rows.film_width = count, self.stride, depth, width
        rows.first = wp.full(1, -1, dtype=wp.int32, device=device)
        rows.scatterings = wp.zeros(count, dtype=wp.int32, device=device)
        for name, more in _kept(self.fields).items():
            dtype = Rows.vars[name].type.dtype
            setattr(rows, name, wp.zeros(count * (depth + more), dtype=dtype, device=device))
        self._counts, self._offsets = (wp.zeros(count, dtype=wp.int32, device=device) for _ in range(2))
        self._sum, self._gather = make_gather(self.fields)
        self._storage: dict[str, wp.array] = {}  # grows to the largest pass so far

    def modules(self) -> list:
        return [self._sum.module, self._gather.module]

    def begin(self, sample: int) -> None:
        """Before the pass of this sample: another k-th of the pixels, and no scatterings."""
        self.rows.first.fill_(sample % self.stride)
        self.rows.scatterings.zero_()

    def collect(self) -> Records:
        """After the pass."""
        rows = self.rows
        wp.launch(self._sum, dim=rows.count, inputs=[rows, self._counts], device=self.device)
        wp.utils.array_scan(self._counts, self._offsets, inclusive=False)
        last = slice(rows.count - 1, rows.count)
        total = int(self._offsets[last].numpy()[0]) + int(self._counts[last].numpy()[0])
        arrays = {name: self._space(name, total) for name in self.fields}
        out = RecordArrays()
        for name, array in arrays.items():
            setattr(out, name, array)
        if total:
            wp.launch(self._gather, dim=rows.count, inputs=[rows, self._offsets, out], device=self.device)
        first = int(rows.first.numpy()[0])
        paths = len(range(first, self.pixels, self.stride))
        rows.first.fill_(-1)
        return Records(count=total, path_count=paths, camera=rows.arrival[:paths], **arrays)

    def _space(self, name: str, count: int) -> wp.array:
        """`count` entries for a field."""
        if count == 0:
            return wp.empty(0, dtype=FIELDS[name], device=self.device)
        array = self._storage.get(name)
        if array is None or array.shape[0] < count:
            array = self._storage[name] = wp.empty(count, dtype=FIELDS[name], device=self.device)
        return array[:count]


def scratch_arrays(fields: tuple[str, ...], light_sampling: bool) -> tuple[str, ...]:
    """Names of the arrays of `RecordScratch` that a worker needs."""
    if not fields:
        return ()
    names = ("beta", "emission")
    if light_sampling:
        names += ("light", "visible") + (("whole_emission", "no_pdf") if "taken" in fields else ())
    return names
