"""The plot of `tools.bench_accel`: what queries and hierarchies cost against the number of triangles."""

from __future__ import annotations

from pathlib import Path

from wavefront.scene.images import replacing

# Kind of ray and sort of query of the panels above.
ABOVE = (("primary", "closest"), ("bounce", "closest"), ("shadow", "any"))


def _curves(cases: list[dict], group: str, names, value) -> dict[str, list[tuple[int, float]]]:
    """By name, (triangles, value) where there is a value."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for case in cases:
        for name, entry in case[group].items():
            if (name in names) and (y := value(entry)) is not None:
                curves.setdefault(name, []).append((case["triangles"], y))
    return curves


def write_plot(path: Path, account: dict) -> None:
    """Writes a PNG, whole or not at all.

    Args:
        path: The file.
        account: Of `tools.bench_accel`; its cases of closed generated meshes are drawn, and of the leaf sizes of
            `wp.Mesh` that which is the best on the largest of them.
    """
    from matplotlib.figure import Figure

    cases = sorted((case for case in account["cases"] if case["generated"]), key=lambda case: case["triangles"])
    best = cases[-1]["best_mesh"]

    def wanted(group):
        names = dict.fromkeys(name for case in cases for name in case[group])
        return [name for name in names if not name.startswith("wp.Mesh") or name == best]

    canvas = Figure(figsize=(15.0, 8.0), layout="constrained")
    axes = canvas.subplots(2, 3)
    for panel, (kind, sort) in zip(axes[0], ABOVE, strict=True):
        curves = _curves(
            cases,
            "engines",
            wanted("engines"),
            lambda e, k=kind, s=sort: 1e3 / e["measured"][k][s]["mrays_per_second"]["median"],
        )
        _draw(panel, curves, f"{kind} rays, {sort} hit", "ns a ray, median")
    structures = wanted("structures")

    def per_triangle(name):
        return lambda entry: entry[name]

    seconds = _curves(cases, "structures", structures, lambda e: e["build_seconds"]["median"])
    costs = {name: [(n, 1e6 * s / n) for n, s in curve] for name, curve in seconds.items()}
    _draw(axes[1, 0], costs, "building", "µs a triangle, median")
    memory = _curves(cases, "structures", structures, per_triangle("resident_bytes_per_triangle"))
    exact = _curves(cases, "structures", structures, per_triangle("bytes_per_triangle"))
    memory |= {f"{name}, its arrays": curve for name, curve in exact.items()}
    _draw(axes[1, 1], memory, "memory by which the process grows", "bytes a triangle", logarithmic=False)
    sah = _curves(cases, "structures", structures, lambda e: e["statistics"] and e["statistics"]["sah_cost"])
    _draw(axes[1, 2], sah, "SAH cost", "node visits, weighted with blocks", logarithmic=False)
    machine, settings = account["machine"], account["settings"]
    canvas.suptitle(f"{machine['cpu']}, {settings['device']}, {settings['threads']} threads")
    with replacing(path) as temporary:
        canvas.savefig(temporary, dpi=110)


def _draw(panel, curves, title, label, logarithmic=True):
    for name, curve in curves.items():
        panel.plot(*zip(*curve, strict=True), "o-", label=name)
    panel.set_xscale("log")
    if logarithmic:
        panel.set_yscale("log")
    else:
        panel.set_ylim(bottom=0.0)
    panel.set_title(title)
    panel.set_xlabel("triangles")
    panel.set_ylabel(label)
    panel.grid(True, which="both", alpha=0.3)
    if curves:
        panel.legend()
