"""A clear sky and its sun in daylight: Preetham, Shirley and Smits 1999, *A Practical Analytic Model for Daylight*.

The sky is the luminance and chromaticity distribution of Perez et al. 1993 with the paper's fits to turbidity
(appendix A.2); the sun is the extraterrestrial spectrum attenuated by the paper's formulas and tables (appendix A.1).
Both hold for turbidities from 2 (very clear) to 10 (hazy) and a sun above the horizon. The ground is black, as that of
Mitsuba's `sunsky`: what is seen below the horizon is for the scene to provide.

Radiance is in W / (m^2 sr nm), averaged over the visible spectrum by the luminous efficiency, as Mitsuba's: luminance
in cd / m^2 divided by 683.002 lm / W and by the 106.857 nm of the efficiency's integral. Against Mitsuba's sky (Hosek
and Wilkie 2012) the mean luminance is 1.2 to 1.6 times as high at turbidity 3 with the sun above 20 degrees, and up to
three times at the ends of the range; the sun is darker near the horizon.
"""

from __future__ import annotations

import datetime

import numpy as np

LEAST_TURBIDITY, LARGEST_TURBIDITY = 2.0, 10.0
SUN_ANGLE = 0.2665  # angular radius, degrees
EFFICACY = 683.002 * 106.857

_XYZ_TO_RGB = np.array(  # IEC 61966-2-1
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)

# Perez coefficients A to E as (slope, constant) in turbidity, for luminance Y and chromaticities x and y.
_PEREZ = np.array(
    [
        [(0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)],
        [(-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)],
        [(-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)],
    ]
)
# Zenith chromaticities: rows for turbidity^2, turbidity, 1; columns for the cube to the 0th power of the sun's angle.
_ZENITH_X = np.array(
    [(0.00166, -0.00375, 0.00209, 0.0), (-0.02903, 0.06377, -0.03202, 0.00394), (0.11693, -0.21196, 0.06052, 0.25886)]
)
_ZENITH_Y = np.array(
    [(0.00275, -0.00610, 0.00317, 0.0), (-0.04214, 0.08970, -0.04153, 0.00516), (0.15346, -0.26756, 0.06670, 0.26688)]
)

# From 380 to 750 nm in steps of 10 nm: the sun outside the atmosphere, W / (m^2 sr nm), and the absorption of ozone,
# 1 / cm. Water vapour absorbs from 690 nm on. The bands of mixed gases lie outside.
_WAVELENGTHS = np.arange(380.0, 751.0, 10.0)
_SOLAR = np.array(
    [16559.0, 16233.7, 21127.5, 25888.2, 25829.1, 24232.3, 26760.5, 29658.3, 30545.4, 30057.5, 30663.7, 28830.4,
     28712.1, 27825.0, 27100.6, 27233.6, 26361.3, 25503.8, 25060.2, 25311.6, 25355.9, 25134.2, 24631.5, 24173.2,
     23685.3, 23212.1, 22827.7, 22339.8, 21970.2, 21526.7, 21097.9, 20728.3, 20240.4, 19870.8, 19427.2, 19072.4,
     18628.9, 18259.2]
)  # fmt: skip
_OZONE = np.array(
    [0, 0, 0, 0, 0, 0, 0, 3, 6, 9, 14, 21, 30, 40, 48, 63, 75, 85, 103, 120, 120, 115, 125, 120, 105, 90, 79, 67, 57,
     48, 36, 28, 23, 18, 14, 11, 10, 9]
) / 1000.0  # fmt: skip
_WATER = np.zeros(len(_WAVELENGTHS))
_WATER[-7:] = 0.016, 0.024, 0.0125, 1.0, 0.87, 0.061, 0.001


def sky_radiance(cos_zenith: np.ndarray, cos_sun: np.ndarray, turbidity: float, sun_zenith: float) -> np.ndarray:
    """Linear Rec. 709 radiance of the sky above the horizon, [..., 3]; colours outside of the gamut are cut off at 0.

    Args:
        cos_zenith: Of the angle to the zenith, > 0, [...].
        cos_sun: Of the angle to the sun, [...].
        turbidity: 2 to 10.
        sun_zenith: Angle of the sun to the zenith, radians, less than pi / 2.
    """
    coefficients = _PEREZ @ (turbidity, 1.0)
    powers = np.array([turbidity**2, turbidity, 1.0])
    angle = np.array([sun_zenith**3, sun_zenith**2, sun_zenith, 1.0])
    chi = (4.0 / 9.0 - turbidity / 120.0) * (np.pi - 2.0 * sun_zenith)
    luminance = (4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192  # kcd / m^2
    zenith = (1000.0 * luminance, powers @ _ZENITH_X @ angle, powers @ _ZENITH_Y @ angle)
    gamma = np.arccos(np.clip(cos_sun, -1.0, 1.0))

    def perez(k, cosine, angle, cos_angle):
        a, b, c, d, e = k
        return (1.0 + a * np.exp(b / cosine)) * (1.0 + c * np.exp(d * angle) + e * cos_angle * cos_angle)

    Y, x, y = (
        value * perez(k, cos_zenith, gamma, cos_sun) / perez(k, 1.0, sun_zenith, np.cos(sun_zenith))
        for value, k in zip(zenith, coefficients, strict=True)
    )
    Y = Y / EFFICACY
    return np.maximum(np.stack([Y * x / y, Y, Y * (1.0 - x - y) / y], axis=-1) @ _XYZ_TO_RGB.T, 0.0)


def sun_radiance(turbidity: float, sun_zenith: float) -> np.ndarray:
    """Mean linear Rec. 709 radiance of the sun's disc of radius `SUN_ANGLE`, [3], seen through the atmosphere.

    Colours by the fits to the CIE 1931 observer of Wyman, Sloan and Shirley 2013; a negative channel becomes 0.
    """
    micrometres = _WAVELENGTHS / 1000.0
    mass = 1.0 / (np.cos(sun_zenith) + 0.15 * (93.885 - np.degrees(sun_zenith)) ** -1.253)
    depth = 0.008735 * micrometres**-4.08  # Rayleigh
    depth += (0.04608 * turbidity - 0.04586) * micrometres**-1.3  # aerosol, by Angstrom
    depth += 0.35 * _OZONE  # cm of ozone
    depth += 0.2385 * 2.0 * _WATER / (1.0 + 20.07 * 2.0 * _WATER * mass) ** 0.45  # cm of water
    spectrum = _SOLAR * np.exp(-mass * depth)

    def lobe(scale, mean, left, right):
        return scale * np.exp(-0.5 * ((_WAVELENGTHS - mean) / np.where(mean > _WAVELENGTHS, left, right)) ** 2)

    observer = np.stack(
        [
            lobe(1.056, 599.8, 37.9, 31.0) + lobe(0.362, 442.0, 16.0, 26.7) + lobe(-0.065, 501.1, 20.4, 26.2),
            lobe(0.821, 568.8, 46.9, 40.5) + lobe(0.286, 530.9, 16.3, 31.1),
            lobe(1.217, 437.0, 11.8, 36.0) + lobe(0.681, 459.0, 26.0, 13.8),
        ]
    )
    xyz = observer @ spectrum * 10.0 / 106.857
    return np.maximum(_XYZ_TO_RGB @ xyz, 0.0)


def bake_sky(turbidity: float, to_sun: np.ndarray, up: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The sky as the pixels of an environment map (see `wavefront.light.envmap`), without the disc of the sun.

    With an even number of rows, half of the row of cells at the horizon belongs to the sky, so no light is lost there.

    Args:
        turbidity: 2 to 10.
        to_sun: Unit vector.
        up: Unit vector to the zenith.
        rows: Height of the map; its width is twice that.

    Returns:
        Pixels, [rows, 2 * rows, 3] float32, and the matrix from the map's axes to the world's; the map's +Y is up.
    """
    theta = np.linspace(0.0, np.pi, rows)[:, None]
    phi = np.pi * (np.arange(2 * rows) + 0.5) / rows
    local_x, local_y, local_z = np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)
    x = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    x /= np.linalg.norm(x)
    to_world = np.stack([x, up, np.cross(x, up)], axis=1)
    sun = to_sun @ to_world
    pixels = np.zeros((rows, 2 * rows, 3), np.float32)
    above = theta[:, 0] < 0.5 * np.pi
    cos_sun = (local_x * sun[0] + local_y * sun[1] + local_z * sun[2])[above]
    pixels[above] = sky_radiance(local_y[above], cos_sun, turbidity, np.arccos(np.clip(sun[1], -1.0, 1.0)))
    return pixels, to_world


def sun_position(when: datetime.datetime, latitude: float, longitude: float, timezone: float) -> np.ndarray:
    """Unit vector to the sun as (east, north, up), without refraction.

    By the low-precision formulas of the Astronomical Almanac (Michalsky 1988), good to 0.02 degrees from 1950 to 2050.

    Args:
        when: Local time.
        latitude: Degrees, north positive.
        longitude: Degrees, east positive.
        timezone: Hours of local time ahead of Universal Time.
    """
    hours = when.hour + (when.minute + (when.second + 1e-6 * when.microsecond) / 60.0) / 60.0 - timezone
    days = when.toordinal() + 1721424.5 + hours / 24.0 - 2451545.0  # since the epoch J2000
    anomaly = np.radians(357.528 + 0.9856003 * days)
    ecliptic = np.radians(280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    obliquity = np.radians(23.439 - 4e-7 * days)
    ascension = np.arctan2(np.cos(obliquity) * np.sin(ecliptic), np.cos(ecliptic))
    declination = np.arcsin(np.sin(obliquity) * np.sin(ecliptic))
    sidereal = np.radians(15.0 * (6.697375 + 0.0657098242 * days + hours) + longitude)
    hour_angle, latitude = sidereal - ascension, np.radians(latitude)
    east = -np.cos(declination) * np.sin(hour_angle)
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(hour_angle)
    up = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour_angle)
    return np.array([east, north, up])
