"""One path again, step by step: the same kernels and random numbers as in a render, with a look at the state between.

Any path of a render can be traced alone, because its random numbers belong to its pixel and sample. What stages decide
without leaving a trace is found by running them twice: once with the radiance at zero, to see exactly what they add,
and once without Russian roulette, to tell what it decides from what the BSDF absorbs.
"""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import warp as wp
from rich.table import Table

from wavefront import queues
from wavefront.accel.geometry import hit_type
from wavefront.errors import WavefrontError
from wavefront.film import Film
from wavefront.integrator import Tile, Worker
from wavefront.light.sampling import LightSample
from wavefront.light.tables import KINDS as LIGHT_KINDS
from wavefront.queues import Paths
from wavefront.scene import description
from wavefront.scene.lookup import indexed_shapes, resolve_bsdf
from wavefront.stages.inspect import make_inspect_hit, make_inspect_light
from wavefront.stages.scatter import survival_probability

NO_ROULETTE = 2**31 - 1


@dataclasses.dataclass
class Vertex:
    """A segment of a path and the vertex at its end; None where there is no such thing. World space, metres."""

    depth: int  # segments so far, this one included
    origin: list[float]  # of the ray
    direction: list[float]
    pdf: float  # of the direction, in solid angle; 0 for the camera and for delta directions
    beta: list[float]  # throughput at the end of the segment
    medium: list[float] | None = None  # what absorption on the way left of the throughput
    # The surface
    position: list[float] | None = None
    geometric_normal: list[float] | None = None
    shading_normal: list[float] | None = None
    uv: list[float] | None = None  # if the scene has textures
    shape: str | None = None
    bsdf: str | None = None
    # What happened there
    emission: list[float] | None = None  # added, MIS weight included, by the surface or by what is around the scene
    light: dict | None = None  # the light sample: light, wi, pdf, L, visible, contribution or reason
    scatter: dict | None = None  # the BSDF sample: wi, pdf (0: delta), weight
    roulette: dict | None = None  # probability of survival, survived


@dataclasses.dataclass
class PathTrace:
    """A path of one camera sample."""

    pixel: tuple[int, int]
    sample: int
    seed: int
    L: list[float]  # radiance as the film gets it
    vertices: list[Vertex]
    left_out: list[str]  # stages whose contributions were not finite or negative
    end: str  # why there is no further vertex

    def to_json(self) -> str:
        """JSON text; numbers that are not finite are the strings ``nan``, ``inf`` and ``-inf``."""

        def plain(value):
            if isinstance(value, dict):
                return {k: plain(v) for k, v in value.items()}
            if isinstance(value, (list, tuple)):
                return [plain(v) for v in value]
            return str(value) if isinstance(value, float) and not np.isfinite(value) else value

        return json.dumps(plain(dataclasses.asdict(self)), indent=1, allow_nan=False)

    def to_table(self) -> Table:
        """For the eye."""
        table = Table(title=f"pixel {self.pixel[0]},{self.pixel[1]}, sample {self.sample}, seed {self.seed}")
        table.add_column("vertex", justify="right")
        table.add_column("")
        table.add_column("", overflow="fold")
        for vertex in self.vertices:
            rows = _rows(vertex)
            for i, (name, text) in enumerate(rows):
                table.add_row(str(vertex.depth) if i == 0 else "", name, text, end_section=i == len(rows) - 1)
        table.add_row("", "ends", self.end)
        for stage in self.left_out:
            table.add_row("", "left out", f"a contribution of the {stage} stage that is not finite or negative")
        table.add_row("", "L", _numbers(self.L, 9))
        return table


def _numbers(values, digits=6) -> str:
    return " ".join(f"{value:.{digits}g}" for value in np.atleast_1d(values))


def _rows(v: Vertex) -> list[tuple[str, str]]:
    rows = [("ray", f"from {_numbers(v.origin)} along {_numbers(v.direction)}, pdf {v.pdf:.6g}")]
    if v.medium is not None:
        rows.append(("absorbed", f"on the way, transmittance {_numbers(v.medium)}"))
    rows.append(("beta", _numbers(v.beta)))
    if v.position is not None:
        rows.append(("position", _numbers(v.position)))
        rows.append(("normals", f"geometric {_numbers(v.geometric_normal)}, shading {_numbers(v.shading_normal)}"))
        if v.uv is not None:
            rows.append(("uv", _numbers(v.uv)))
        rows += [("shape", v.shape), ("bsdf", v.bsdf), ("wo", _numbers([-x for x in v.direction]))]
    if v.emission is not None:
        rows.append(("emission", f"+ {_numbers(v.emission)}"))
    if v.light is not None:
        text = f"{v.light['light']}, wi {_numbers(v.light['wi'])}, pdf {v.light['pdf']:.6g}, L {_numbers(v.light['L'])}"
        if "contribution" in v.light:
            sign = "visible, +" if v.light["visible"] else "blocked,"
            text += f"; {sign} {_numbers(v.light['contribution'])}"
        else:
            text += f"; {v.light['reason']}"
        rows.append(("light", text))
    if v.scatter is not None:
        s = v.scatter
        kind = "delta" if s["pdf"] == 0.0 else f"pdf {s['pdf']:.6g}"
        rows.append(("scatter", f"wi {_numbers(s['wi'])}, {kind}, weight {_numbers(s['weight'])}"))
    if v.roulette is not None:
        r = v.roulette
        rows.append(("roulette", f"{'survived' if r['survived'] else 'ended'}, probability {r['probability']:.6g}"))
    return rows


class TraceWorker(Worker):
    """Traces one path at a time and writes down what each stage does.

    Args:
        renderer: Whose paths they are.
    """

    def __init__(self, renderer):
        super().__init__(**worker_arguments(renderer, capacity=1))
        self.renderer, self.vertices, self.left_out, self.end = renderer, [], [], ""
        f, scene = renderer.features, renderer.device_scene
        device = self.device
        self.hit = wp.zeros(1, dtype=hit_type(f.instances), device=device)
        self.light_index = wp.zeros(1, dtype=wp.int32, device=device)
        self.light_sample = wp.zeros(1, dtype=LightSample, device=device)
        tables = [scene.geometry, scene.materials, scene.textures, scene.lights]
        self.inspectors = {
            "intersect": (
                make_inspect_hit(f.triangles, f.spheres, f.instances, f.accel),
                [scene.geometry, self.paths, self.hit],
            )
        }
        if f.light_sampling:
            arguments = [*tables, self.paths, self.surfaces, wp.uint64(renderer.seed), self.queues.counter_struct]
            arguments += [self.light_index, self.light_sample]
            self.inspectors["direct"] = (make_inspect_light(f.lights, f.light_textures, f.sampler), arguments)
        wp.force_load(device, modules=[kernel.module for kernel, _ in self.inspectors.values()])

    def trace(self, x: int, y: int, sample: int) -> PathTrace:
        """The path of one sample of a pixel, which is counted in the whole film, also where a window is rendered."""
        film, window = self.renderer.film, self.renderer.scene.film.window
        column, row = x - window.x, y - window.y
        if not (0 <= column < film.width and 0 <= row < film.height):
            last = f"{window.x + film.width - 1},{window.y + film.height - 1}"
            raise WavefrontError(f"pixel {x},{y} is not in the film; allowed: {window.x},{window.y} to {last}")
        if not 0 <= sample < 2**31 - 1:
            raise WavefrontError(f"sample {sample}; allowed: 0 to 2^31 - 2")
        self.vertices, self.left_out, self.end = [], [], ""
        self.film.arrays.L.zero_()
        tile = Tile(column, row, 1, 1, sample, 1)
        self.tile.assign(np.array(dataclasses.astuple(tile), np.int32))
        self._trace(tile)
        self.check_status()
        L = self.film.arrays.L.numpy()[column].tolist()
        return PathTrace((x, y), sample, self.renderer.seed, L, self.vertices, self.left_out, self.end)

    # --- between the stages ----------------------------------------------------------------------------------------

    def _launch(self, stage: str, size: str | int) -> None:
        if stage not in self.commands:
            return
        before = self._counters()
        entries = before[self.queues.INDEX[size]] if isinstance(size, str) else size
        if entries == 0:
            return
        observe = getattr(self, f"_observe_{stage}", None)
        if observe is None:
            super()._launch(stage, size)
        else:
            observe(stage, size)
        after = self._counters()
        for name, index in queues.NONFINITE_STAGES.items():
            self.left_out += [name] * int(after[index] - before[index])

    def _observe_intersect(self, stage, size):
        ray = {name: self._read(name) for name in ("origin", "direction", "pdf", "beta")}
        self._inspect(stage)
        super()._launch(stage, size)
        counters, beta = self._counters(), self._read("beta")
        v = Vertex(
            depth=int(counters[queues.DEPTH]) + 1,
            origin=ray["origin"].tolist(),
            direction=ray["direction"].tolist(),
            pdf=float(ray["pdf"]),
            beta=beta.tolist(),
        )
        if (beta != ray["beta"]).any():
            v.medium = _ratio(beta, ray["beta"])
        self.vertices.append(v)
        if self.surfaces.material.numpy()[0] < 0:
            self.end = "the ray left the scene"
            return
        for name in ("position", "geometric_normal", "shading_normal"):
            setattr(v, name, getattr(self.surfaces, name).numpy()[0].tolist())
        if self.renderer.features.uvs:
            v.uv = self.surfaces.uv.numpy()[0].tolist()
        v.shape, v.bsdf = self._describe_primitive(int(self.hit.numpy()["primitive"][0]))
        if counters[queues.HITS] == 0:
            self.end = f"the longest path, max_depth {self.renderer.scene.integrator.max_depth}"

    def _observe_emission(self, stage, size):
        self.vertices[-1].emission = self._added(stage, size).tolist()

    _observe_escaped = _observe_emission

    def _observe_direct(self, stage, size):
        self._inspect(stage)
        super()._launch(stage, size)
        index, sample = int(self.light_index.numpy()[0]), self.light_sample.numpy()[0]
        if index < 0:
            return
        light = {"light": self._describe_light(index), "wi": sample["wi"].tolist(), "pdf": float(sample["pdf"])}
        light["L"] = sample["L"].tolist()
        if self._counters()[queues.SHADOW] == 0:
            dark = not sample["L"].any()
            light["reason"] = "no light comes from there" if dark else "the BSDF reflects nothing from there"
        self.vertices[-1].light = light

    def _observe_shadow(self, stage, size):
        contribution = self.shadow_rays.L.numpy()[0].copy()
        added = self._added(stage, size)
        self.vertices[-1].light |= {"visible": bool(added.any()), "contribution": contribution.tolist()}

    def _observe_scatter(self, stage, size):
        v, beta, command = self.vertices[-1], self._read("beta"), self.commands[stage]
        state, counters = self._save(), self._counters()
        # Without Russian roulette.
        command.set_param_by_name("rr_depth", NO_ROULETTE)
        super()._launch(stage, size)
        command.set_param_by_name("rr_depth", self.renderer.scene.integrator.rr_depth or 0)
        after, sampled = self._counters(), self._read("beta")
        if after[queues.RAYS] == 0:
            failed = after[queues.NONFINITE_SCATTER] > counters[queues.NONFINITE_SCATTER]
            self.end = "the BSDF sample is not finite or negative" if failed else "absorbed: a BSDF sample of no weight"
            return  # roulette would have changed nothing
        v.scatter = {
            "wi": self._read("direction").tolist(),
            "pdf": float(self._read("pdf")),
            "weight": _ratio(sampled, beta),
        }
        eta = float(self._read("eta")) if self.renderer.features.transmission else 1.0
        self._restore(state, counters)
        super()._launch(stage, size)
        survived = bool(self._counters()[queues.RAYS])
        if not survived or (self._read("beta") != sampled).any():
            probability = float(survival_probability(wp.vec3(*sampled), eta))
            v.roulette = {"probability": probability, "survived": survived}
        if not survived:
            self.end = "Russian roulette"

    # --- looking ---------------------------------------------------------------------------------------------------

    def _counters(self) -> np.ndarray:
        return self.queues.counters.numpy().copy()

    def _read(self, name: str) -> np.ndarray:
        """A field of the path, float32."""
        return getattr(self.paths, name).numpy()[0].copy()

    def _save(self) -> dict[str, np.ndarray]:
        arrays = {name: getattr(self.paths, name) for name in Paths.vars}
        return {name: array.numpy().copy() for name, array in arrays.items() if array is not None and array.size}

    def _restore(self, state: dict[str, np.ndarray], counters: np.ndarray) -> None:
        for name, values in state.items():
            getattr(self.paths, name).assign(values)
        self.queues.counters.assign(counters)

    def _added(self, stage, size) -> np.ndarray:
        """Runs a stage that adds radiance to the path, and gives exactly what it adds."""
        state, counters = self._save(), self._counters()
        self.paths.L.zero_()
        super()._launch(stage, size)
        added = self._read("L")
        self._restore(state, counters)
        super()._launch(stage, size)
        return added

    def _inspect(self, stage: str) -> None:
        kernel, arguments = self.inspectors[stage]
        wp.launch(kernel, dim=1, inputs=arguments, device=self.device)

    def _describe_primitive(self, primitive: int) -> tuple[str, str]:
        """Shape and BSDF, as in ``shapes[5] "tall box" (cube)`` and ``white (twosided, diffuse)``."""
        scene, geometry = self.renderer.scene, self.renderer.device_scene.geometry
        index = int(geometry.shapes.numpy()[geometry.shape_of.numpy()[primitive]]["index"])
        path, shape = list(indexed_shapes(scene))[index]
        record, tags = resolve_bsdf(scene, shape.bsdf), []
        name = record.name
        while record is not None:
            tags.append(_tag(record))
            inner = getattr(record, "bsdf", None) or getattr(record, "front", None)
            record = resolve_bsdf(scene, inner) if inner is not None else None
        return f"{path} {_named(shape.name, [_tag(shape)])}", _named(name, tags)

    def _describe_light(self, index: int) -> str:
        light = self.renderer.device_scene.lights.lights.numpy()[index]
        kind = next(name for name, number in LIGHT_KINDS.items() if number == light["kind"])
        if light["primitive"] >= 0:
            return f"light {index}, {kind} of {self._describe_primitive(int(light['primitive']))[0]}"
        return f"light {index}, {kind}"


def _tag(record: description.Record) -> str:
    return type(record).__struct_config__.tag


def _named(name: str | None, tags: list[str]) -> str:
    return f'"{name}" ({", ".join(tags)})' if name else ", ".join(tags)


def _ratio(after: np.ndarray, before: np.ndarray) -> list[float]:
    """The factor of a throughput; zero where it was zero."""
    return np.divide(after, before, out=np.zeros_like(after), where=before != 0.0).tolist()


def worker_arguments(renderer, capacity: int) -> dict:
    """Arguments of a `Worker` that traces what the renderer's workers trace, without touching its film: every row of
    pixels goes to the only row of a film of its own."""
    film = Film(renderer.film.width, 1, renderer.film.aovs, renderer.device)
    return {
        "scene": renderer.scene,
        "device_scene": renderer.device_scene,
        "features": renderer.features,
        "kernels": renderer.kernels,
        "film": film,
        "film_stride": 0,
        "seed": renderer.seed,
        "capacity": capacity,
        "device": renderer.device,
    }
