"""The figure of `tools.inspect_guide`."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np

from wavefront.errors import WavefrontError
from wavefront.output import tone_map
from wavefront.scene.images import replacing

DECADES = 4.0  # of the colour scale of densities
STOPS = 4.0  # of the ratio, either way


def need_matplotlib() -> None:
    """Raises WavefrontError where matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise WavefrontError(
            "the figure needs matplotlib, which is not installed; it comes with pip install '.[measure]'"
        ) from None


def write_figure(
    path: Path,
    title: str,
    image_title: str,
    image: np.ndarray,
    pixel: tuple[float, float],
    radiance: np.ndarray,
    densities: dict[str, np.ndarray],
    ratio: np.ndarray,
    visible: np.ndarray,
    exposure: float,
) -> None:
    """Writes the figure as a PNG, whole or not at all.

    Args:
        path: The file.
        title: Above all.
        image_title: Of the image.
        image: With the pixel in it, linear, [height, width, 3].
        pixel: Column and row of the pixel in it.
        radiance: What arrives, linear, [rows, columns, 3].
        densities: Three by their titles, [rows, columns], per steradian, in one logarithmic scale of colours.
        ratio: The learned density over that of the target; where that means nothing, not a number.
        visible: Directions that the surface scatters light from; the others are greyed.
        exposure: Stops, of both images.

    Raises:
        WavefrontError: matplotlib is not installed, or the file cannot be written.
    """
    need_matplotlib()
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(15.0, 7.4), layout="constrained")
    axes = canvas.subplots(2, 3)
    lines = [part for line in title.splitlines() for part in textwrap.wrap(line, 170)]
    canvas.suptitle(_plain("\n".join(lines)), fontsize=11)

    axes[0, 0].imshow(tone_map(image, exposure))
    axes[0, 0].plot(*pixel, "o", markersize=11, markerfacecolor="none", markeredgecolor="black", markeredgewidth=3.0)
    axes[0, 0].plot(*pixel, "o", markersize=11, markerfacecolor="none", markeredgecolor="white", markeredgewidth=1.2)
    axes[0, 0].set_title(f"{image_title}, and the pixel")
    axes[0, 0].set_axis_off()

    on_map = {"extent": (-180.0, 180.0, -90.0, 90.0), "interpolation": "nearest"}
    seen = tone_map(radiance, exposure)
    axes[0, 1].imshow(np.where(visible[..., None], seen, seen // 2 + 64), **on_map)
    axes[0, 1].set_title("traced incident radiance")

    # Single cells of a noisy target would darken all the rest.
    top = max(float(np.quantile(values, 0.999)) for values in densities.values())
    norm = LogNorm(vmin=top * 10.0**-DECADES, vmax=top)
    colours = colormaps["inferno"].with_extremes(bad="0.5")
    drawn = (axes[0, 2], axes[1, 0], axes[1, 1])
    for panel, (name, values) in zip(drawn, densities.items(), strict=True):
        shown = np.where(values > 0.0, np.clip(values, norm.vmin, norm.vmax), np.nan)
        mappable = panel.imshow(shown, norm=norm, cmap=colours, **on_map)
        panel.set_title(_plain(name))
    canvas.colorbar(mappable, ax=list(axes[:, 2]), label="density, 1/sr; grey: zero", shrink=0.45, anchor=(0.0, 1.0))

    with np.errstate(divide="ignore"):
        stops = np.clip(np.log2(ratio), -STOPS, STOPS)
    diverging = colormaps["RdBu_r"].with_extremes(bad="0.5")
    mappable = axes[1, 2].imshow(stops, vmin=-STOPS, vmax=STOPS, cmap=diverging, **on_map)
    axes[1, 2].set_title("learned / target")
    bar = canvas.colorbar(mappable, ax=axes[1, 2], label="factor", shrink=0.9)
    ticks = np.arange(-STOPS, STOPS + 1.0)
    bar.set_ticks(ticks, labels=[f"{2.0**t:g}" for t in ticks])

    rows, columns = visible.shape
    longitude = (np.arange(columns) + 0.5) / columns * 360.0 - 180.0
    latitude = 90.0 - (np.arange(rows) + 0.5) / rows * 180.0
    for panel in (axes[0, 1], *drawn, axes[1, 2]):
        if visible.any() and not visible.all():
            style = {"colors": "white", "linewidths": 0.8, "linestyles": ":"}
            panel.contour(longitude, latitude, visible.astype(float), levels=[0.5], **style)
        panel.set_xticks(np.arange(-180, 181, 90), labels=["+Z", "-X", "-Z", "+X", "+Z"])
        panel.set_yticks([-90, -45, 0, 45, 90], labels=["-Y", "45° below", "level", "45° above", "+Y"], fontsize=8)
    with replacing(path) as temporary:
        canvas.savefig(temporary, dpi=110)


def _plain(text: str) -> str:
    return text.replace("$", r"\$")  # a dollar would begin a formula
