// The image viewer: its state, and how it is drawn.

const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const root = $("viewer"), stage = $("stage");
const table = Uint8Array.from(atob(data.colours), (letter) => letter.charCodeAt(0));

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key in made) made[key] = value;
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

const digits = (x) => (x === 0 ? "0" : Math.abs(x) >= 1e-3 && Math.abs(x) < 1e5 ? String(+x.toPrecision(3))
  : x.toExponential(2));
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// --- state ----------------------------------------------------------------------------------------------------------

// Images of a scene: number 0 is the reference, the others are the methods in their order.
const state = {
  scene: 0, budget: 0, number: 1, against: 0, mode: "single", split: 0.5, error: false, metric: data.metrics[0],
};
const perScene = data.scenes.map((scene) => ({
  x: scene.width / 2, y: scene.height / 2, zoom: 1, // of the point in the middle; 1: the whole image is seen
  exposure: 0, white: {}, crops: scene.crops.map((crop) => ({...crop})),
}));
const scene = () => data.scenes[state.scene];
const own = () => perScene[state.scene];
const count = () => data.methods.length + 1;
const nameOf = (number) => (number === 0 ? "reference" : data.methods[number - 1]);

// Where the pixels of an image are: {pixels, exponent, errors, flip}; nothing if it was not kept.
function entryOf(number) {
  return number === 0 ? scene().reference : scene().images.find(
    (image) => image.method === number - 1 && image.budget === state.budget);
}

// --- decoded images and pictures of them ----------------------------------------------------------------------------

const loaded = new Map(); // by number of pixels: {halves, exponent}, or null while it is decoded

function load(pixels, exponent) {
  if (!loaded.has(pixels)) {
    loaded.set(pixels, null);
    decodePixels($(`pixels-${pixels}`).textContent, scene().width * scene().height)
      .then((halves) => loaded.set(pixels, {halves, exponent, id: pixels, maps: {}}), fail)
      .then(update);
  }
  return loaded.get(pixels);
}

function fail(error) {
  $("failure").hidden = false;
  $("failure").textContent = `The images cannot be shown: ${error.message}. They need a browser of 2023 or later.`;
}

// The error of every pixel of the image of a method; null while something is decoded.
function mapOf(number) {
  const entry = entryOf(number);
  const image = load(entry.pixels, entry.exponent), reference = load(scene().reference.pixels, scene().reference.exponent);
  if (!image || !reference) return null;
  if (!image.maps[state.metric]) {
    if (state.metric === "flip") {
      const map = load(entry.flip.pixels, entry.flip.exponent);
      if (!map) return null;
      image.maps.flip = grey(map);
    } else {
      image.maps[state.metric] = errorMap(state.metric, image, reference);
    }
  }
  return image.maps[state.metric];
}

// The error that is white: for the first method that has an image, 2 % of the pixels have more.
function white() {
  const key = state.metric;
  if (own().white[key] === undefined) {
    const number = data.methods.findIndex((_, i) => entryOf(i + 1)) + 1;
    const map = number > 0 ? mapOf(number) : new Float32Array(1);
    if (!map) return null;
    own().white[key] = roundQuantile(map, 0.98);
  }
  return own().white[key];
}

const pictures = new Map(); // by number of pixels: {key, canvas}

// A canvas of an image as it is to be seen, with one pixel for each of the image; null while something is decoded. The
// reference, which has no error, is always seen itself.
function pictureOf(number) {
  const entry = entryOf(number), image = entry && load(entry.pixels, entry.exponent), error = state.error && number > 0;
  if (!image) return null;
  const map = error ? mapOf(number) : null, range = error ? white() : null;
  if (error && !(map && range)) return null;
  const key = error ? `${state.metric} ${range}` : `${own().exposure}`;
  let picture = pictures.get(entry.pixels);
  if (!picture) {
    picture = {canvas: element("canvas", {width: scene().width, height: scene().height})};
    pictures.set(entry.pixels, picture);
  }
  if (picture.key !== key) {
    const context = picture.canvas.getContext("2d"), out = context.createImageData(scene().width, scene().height);
    if (error) falseColour(map, range, table, out.data);
    else toneMap(image, own().exposure, out.data);
    context.putImageData(out, 0, 0);
    picture.key = key;
  }
  return picture.canvas;
}

// --- panes ----------------------------------------------------------------------------------------------------------

let panes = [], layout = "";

function makePanes() {
  const numbers = state.mode === "grid" ? [...Array(count()).keys()].filter(entryOf) : [state.number];
  const key = `${state.mode} ${state.scene} ${numbers.length}`;
  if (key !== layout) {
    layout = key;
    stage.className = state.mode;
    panes = numbers.map(() => {
      const canvas = element("canvas", {role: "img"}), caption = element("figcaption");
      listen(canvas);
      return {canvas, caption, figure: element("figure", {className: "pane"}, canvas, caption)};
    });
    stage.replaceChildren(...panes.map((pane) => pane.figure));
  }
  panes.forEach((pane, i) => { pane.number = numbers[i]; });
}

// Gives a canvas its size in device pixels; returns how many of them a pixel has when the whole image is seen.
function measure(canvas) {
  const ratio = window.devicePixelRatio || 1, width = canvas.parentElement.clientWidth;
  const height = Math.min(width * scene().height / scene().width, Math.max(0.7 * window.innerHeight, 240));
  canvas.style.height = `${height}px`;
  const w = Math.max(Math.round(width * ratio), 1), h = Math.max(Math.round(height * ratio), 1);
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  return Math.min(w / scene().width, h / scene().height);
}

const captionOf = (number) => {
  const entry = entryOf(number);
  if (!entry) return `${nameOf(number)}: no image was kept`;
  const error = number > 0 ? `, ${data.labels[data.shown]} ${digits(entry.errors[data.shown])}` : "";
  return number === 0 ? `reference (${entry.words})` : `${nameOf(number)}${error}`;
};

function drawPane(pane) {
  pane.fit = measure(pane.canvas);
  const scale = pane.scale = pane.fit * own().zoom, {width, height} = pane.canvas;
  const context = pane.canvas.getContext("2d");
  pane.left = width / 2 - own().x * scale;
  pane.top = height / 2 - own().y * scale;
  context.clearRect(0, 0, width, height);
  context.imageSmoothingEnabled = scale < 1;
  const numbers = state.mode === "wipe" ? [pane.number, state.against] : [pane.number];
  const line = Math.round(state.split * width);
  let complete = true;
  numbers.forEach((number, side) => {
    const picture = pictureOf(number);
    complete &&= Boolean(picture) || !entryOf(number);
    if (!picture) return;
    context.save();
    if (numbers.length === 2) {
      context.beginPath();
      context.rect(side ? line : 0, 0, side ? width - line : line, height);
      context.clip();
    }
    context.drawImage(picture, pane.left, pane.top, scene().width * scale, scene().height * scale);
    context.restore();
  });
  if (numbers.length === 2) drawLine(context, line, height);
  if (drag?.kind === "crop" && drag.crop) {
    const {x, y, w, h} = drag.crop;
    outline(context, pane.left + x * scale, pane.top + y * scale, w * scale, h * scale);
  }
  const words = numbers.map(captionOf);
  pane.canvas.dataset.view = [pane.left, pane.top, scale].join(" "); // for tests
  pane.canvas.setAttribute("aria-label", words.join(", and on the right "));
  pane.caption.replaceChildren(...words.map((text) => element("span", {}, text)));
  return complete;
}

function drawLine(context, x, height) {
  context.fillStyle = "#000";
  context.fillRect(x - 2, 0, 4, height);
  context.fillStyle = "#fff";
  context.fillRect(x - 1, 0, 2, height);
  context.beginPath();
  context.arc(x, height / 2, 7, 0, 2 * Math.PI);
  context.fill();
  context.strokeStyle = "#000";
  context.stroke();
}

function outline(context, x, y, w, h) {
  for (const [colour, width] of [["#000", 4], ["#fff", 2]]) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.strokeRect(x, y, w, h);
  }
}

// --- crops ----------------------------------------------------------------------------------------------------------

const CROP = 190; // largest side on the page, CSS pixels

function drawCrops() {
  const numbers = [...Array(count()).keys()].filter(entryOf);
  $("no-crops").hidden = own().crops.length > 0;
  const key = [state.scene, state.budget, numbers, own().crops.map((c) => [c.x, c.y, c.w, c.h])].join(" ");
  if ($("crops").dataset.key !== key) {
    $("crops").dataset.key = key;
    $("crops").replaceChildren(...own().crops.map((crop) => makeCrop(crop, numbers)));
  }
  let complete = true;
  for (const canvas of $("crops").querySelectorAll("canvas")) {
    const crop = own().crops[canvas.dataset.crop], number = Number(canvas.dataset.number), picture = pictureOf(number);
    if (!picture) {
      complete = false;
      continue;
    }
    canvas.getContext("2d").drawImage(picture, crop.x, crop.y, crop.w, crop.h, 0, 0, crop.w, crop.h);
    canvas.nextSibling.lastChild.textContent = cropError(crop, number);
  }
  return complete;
}

function makeCrop(crop, numbers) {
  const index = own().crops.indexOf(crop), scale = CROP / Math.max(crop.w, crop.h);
  const name = element("input", {type: "text", value: crop.name, "aria-label": "Name of the crop", size: 16});
  name.addEventListener("input", () => { crop.name = name.value; });
  const remove = element("button", {}, "Remove");
  remove.addEventListener("click", () => { own().crops.splice(index, 1); stage.focus(); update(); });
  const row = numbers.map((number) => {
    const canvas = element("canvas", {width: crop.w, height: crop.h, role: "img"});
    canvas.setAttribute("aria-label", `${crop.name}: ${nameOf(number)}`);
    canvas.dataset.crop = index;
    canvas.dataset.number = number;
    canvas.style.width = `${crop.w * scale}px`;
    canvas.style.height = `${crop.h * scale}px`;
    const caption = element("figcaption", {}, nameOf(number), element("br"), element("span"));
    caption.style.maxWidth = `${Math.max(crop.w * scale, 90)}px`;
    return element("figure", {}, canvas, caption);
  });
  const place = element("span", {className: "muted"}, `${crop.w}x${crop.h}+${crop.x}+${crop.y}`);
  return element("div", {className: "crop"}, element("div", {className: "bar"}, name, place, remove),
    element("div", {className: "row"}, ...row));
}

function cropError(crop, number) {
  const map = number > 0 && mapOf(number);
  if (!map) return "";
  let sum = 0;
  for (let y = crop.y; y < crop.y + crop.h; y++) {
    for (let x = crop.x; x < crop.x + crop.w; x++) sum += map[y * scene().width + x];
  }
  return `${data.labels[state.metric]} ${digits(sum / (crop.w * crop.h))}`;
}

// --- what is shown --------------------------------------------------------------------------------------------------

let due = false;

function update() {
  root.dataset.ready = "false";
  if (!due) requestAnimationFrame(draw);
  due = true;
}

function draw() {
  due = false;
  showControls();
  makePanes();
  const complete = panes.map(drawPane).every(Boolean);
  const cropped = drawCrops();
  if (state.error) $("white-value").value = digits(white() ?? NaN);
  root.dataset.ready = String(complete && cropped);
}
