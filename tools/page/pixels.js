// Pixels of the page: decoding, tone mapping, errors. Nothing here draws or knows of the page.

const HALVES = 65536;

// Values of all IEEE 754 half floats; infinities and NaN are not used.
const HALF = Float32Array.from({length: HALVES}, (_, bits) => {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023;
  const size = exponent ? (1024 + fraction) * 2 ** (exponent - 25) : fraction * 2 ** -24;
  return bits & 32768 ? -size : size;
});

// The halves of an image of so many pixels, the channels of each together, from the text of tools/report_pixels.py.
async function decodePixels(text, pixels) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return interleave(new Uint8Array(await new Response(stream).arrayBuffer()), pixels);
}

function interleave(bytes, pixels) {
  const count = bytes.length / 2, channels = count / pixels;
  const halves = new Uint16Array(count);
  const at = (channel, i) => (bytes[channel * pixels + i] << 8) | bytes[count + channel * pixels + i];
  for (let i = 0; i < pixels; i++) {
    if (channels === 1) {
      halves[i] = at(0, i);
    } else {
      const green = at(1, i);
      halves[3 * i] = at(0, i) + green;
      halves[3 * i + 1] = green;
      halves[3 * i + 2] = at(2, i) + green;
    }
  }
  return halves;
}

const curves = new Map();

// 8-bit sRGB of all halves times 2^stops, clipped at 1 (IEC 61966-2-1).
function displayCurve(stops) {
  if (!curves.has(stops)) {
    if (curves.size >= 32) curves.clear();
    const scale = 2 ** stops;
    curves.set(stops, Uint8Array.from(HALF, (half) => {
      const x = Math.min(Math.max(half * scale, 0), 1);
      return 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055) + 0.5;
    }));
  }
  return curves.get(stops);
}

// Colours of an image {halves, exponent}, as RGBA bytes.
function toneMap(image, exposure, out) {
  const curve = displayCurve(exposure + image.exponent), halves = image.halves;
  for (let i = 0, o = 0; i < halves.length; i += 3, o += 4) {
    out[o] = curve[halves[i]];
    out[o + 1] = curve[halves[i + 1]];
    out[o + 2] = curve[halves[i + 2]];
    out[o + 3] = 255;
  }
}

// Errors of a channel of an image i against a reference r, as in tools/metrics.py.
const ERRORS = {
  "mse": (i, r) => (i - r) ** 2,
  "mae": (i, r) => Math.abs(i - r),
  "relmse": (i, r) => (i - r) ** 2 / (r * r + 0.01),
  "trimmed-relmse": (i, r) => (i - r) ** 2 / (r * r + 0.01),
  "mrse": (i, r) => (i - r) ** 2 / (r * r + 0.0001),
  "mape": (i, r) => Math.abs(i - r) / (Math.abs(r) + 0.01),
  "smape": (i, r) => Math.abs(i - r) / (0.5 * (Math.abs(i) + Math.abs(r)) + 0.01),
};

// The error of every pixel.
function errorMap(metric, image, reference) {
  const error = ERRORS[metric], a = 2 ** image.exponent, b = 2 ** reference.exponent;
  const map = new Float32Array(image.halves.length / 3);
  for (let p = 0; p < map.length; p++) {
    for (let i = 3 * p; i < 3 * p + 3; i++) {
      map[p] += error(a * HALF[image.halves[i]], b * HALF[reference.halves[i]]) / 3;
    }
  }
  return map;
}

// Values of an image {halves, exponent} of one channel.
const grey = (image) => Float32Array.from(image.halves, (bits) => 2 ** image.exponent * HALF[bits]);

// False colours from a table of 256: the first for 0, the last for `white` and more.
function falseColour(map, white, table, out) {
  for (let p = 0; p < map.length; p++) {
    const row = 3 * Math.floor(255 * Math.min(Math.max(map[p] / white, 0), 1) + 0.5);
    out[4 * p] = table[row];
    out[4 * p + 1] = table[row + 1];
    out[4 * p + 2] = table[row + 2];
    out[4 * p + 3] = 255;
  }
}

// 1, 2 or 5 times a power of ten that is nearest to the value of which `share` of the map is smaller.
function roundQuantile(map, share) {
  const value = Float32Array.from(map).sort()[Math.min(Math.floor(share * map.length), map.length - 1)];
  if (!(value > 0)) return 1;
  const decade = 10 ** Math.floor(Math.log10(value)), lead = value / decade;
  return decade * (lead < 1.5 ? 1 : lead < 3.5 ? 2 : lead < 7.5 ? 5 : 10);
}
