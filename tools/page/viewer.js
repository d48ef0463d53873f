// The image viewer, and the choice of the metric that the table and the plots show.

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

function press(group, chosen) {
  [...$(group).children].forEach((button) => button.setAttribute("aria-pressed", String(chosen(button))));
}

function showControls() {
  press("scenes", (button) => Number(button.value) === state.scene);
  press("modes", (button) => button.dataset.mode === state.mode);
  press("choices", (button) => Number(button.value) === state.number);
  for (const button of $("choices").children) button.disabled = !entryOf(Number(button.value));
  $("choices").hidden = state.mode === "grid";
  $("wipe-controls").hidden = state.mode !== "wipe";
  $("error-controls").hidden = !state.error;
  $("budget").value = state.budget;
  $("against").value = state.against;
  $("split").value = state.split;
  $("exposure").value = own().exposure;
  $("exposure-value").value = `${own().exposure > 0 ? "+" : ""}${+own().exposure.toFixed(2)} EV`;
  $("zoom-value").value = `${+own().zoom.toFixed(2)}×`;
  $("error").checked = state.error;
  $("error-metric").value = state.metric;
}

function choose(changes) {
  Object.assign(state, changes);
  update();
}

function expose(stops) {
  own().exposure = clamp(Math.round(4 * stops) / 4, -12, 12);
  update();
}

// The mean of the logarithms of the reference's luminances (Reinhard et al. 2002) becomes middle grey.
function exposeByReference() {
  const reference = load(scene().reference.pixels, scene().reference.exponent);
  if (!reference) return;
  let sum = 0, seen = 0;
  for (let i = 0; i < reference.halves.length; i += 3) {
    const [r, g, b] = [0, 1, 2].map((c) => HALF[reference.halves[i + c]] * 2 ** reference.exponent);
    const luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b;
    if (luminance > 0) {
      sum += Math.log2(luminance);
      seen += 1;
    }
  }
  if (seen) expose(Math.log2(0.18) - sum / seen);
}

// Zooms so that what is under a point of a pane, in its pixels, stays there; without a pane, in the middle.
function zoomBy(factor, pane, x, y) {
  const before = own().zoom;
  own().zoom = clamp(before * factor, 0.5, 256);
  if (pane) {
    const keep = (1 / before - 1 / own().zoom) / pane.fit;
    own().x += (x - pane.canvas.width / 2) * keep;
    own().y += (y - pane.canvas.height / 2) * keep;
  }
  clampView();
}

function clampView() {
  own().x = clamp(own().x, 0, scene().width);
  own().y = clamp(own().y, 0, scene().height);
  update();
}

function wholeImage() {
  Object.assign(own(), {x: scene().width / 2, y: scene().height / 2, zoom: 1});
  update();
}

function scaleError(factor) {
  if (white()) own().white[state.metric] *= factor;
  update();
}

function nextImage(step) {
  for (let number = state.number + step; number >= 0 && number < count(); number += step) {
    if (entryOf(number)) return choose({number});
  }
}

function chooseBudget(budget) {
  choose({budget: clamp(budget, 0, data.budgets.length - 1)});
}

function chooseScene(index) {
  state.scene = index;
  if (!scene().images.some((image) => image.budget === state.budget)) {
    state.budget = Math.max(...scene().images.map((image) => image.budget), 0);
  }
  update();
}

// --- mouse ----------------------------------------------------------------------------------------------------------

let drag = null;

function place(event, pane) {
  const box = pane.canvas.getBoundingClientRect();
  const x = (event.clientX - box.left) * pane.canvas.width / box.width;
  const y = (event.clientY - box.top) * pane.canvas.height / box.height;
  return {x, y, column: Math.floor((x - pane.left) / pane.scale), row: Math.floor((y - pane.top) / pane.scale)};
}

function listen(canvas) {
  const pane = () => panes.find((one) => one.canvas === canvas);
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    const at = place(event, pane());
    const onLine = state.mode === "wipe" && Math.abs(at.x - state.split * canvas.width) < 10 * devicePixelRatio;
    drag = {kind: event.shiftKey ? "crop" : onLine ? "line" : "pan", from: at, x: own().x, y: own().y};
    canvas.setPointerCapture(event.pointerId);
    stage.focus({preventScroll: true});
    event.preventDefault();
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = place(event, pane());
    if (drag) dragTo(at, pane());
    else readOut(at, pane());
  });
  const end = () => {
    const crop = drag?.kind === "crop" && drag.crop;
    drag = null;
    if (crop && crop.w > 1 && crop.h > 1) own().crops.push({...crop, name: `crop ${own().crops.length + 1}`});
    update();
  };
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !root.contains(document.activeElement)) return;
    event.preventDefault();
    const at = place(event, pane()), lines = event.deltaMode === 1 ? 33 : 1;
    zoomBy(2 ** (-event.deltaY * lines / (event.ctrlKey ? 100 : 250)), pane(), at.x, at.y);
  }, {passive: false});
}

function dragTo(at, pane) {
  if (drag.kind === "line") {
    choose({split: clamp(at.x / pane.canvas.width, 0, 1)});
  } else if (drag.kind === "pan") {
    own().x = drag.x - (at.x - drag.from.x) / pane.scale;
    own().y = drag.y - (at.y - drag.from.y) / pane.scale;
    clampView();
  } else {
    const columns = [drag.from.column, at.column].map((x) => clamp(x, 0, scene().width - 1)).sort((a, b) => a - b);
    const rows = [drag.from.row, at.row].map((y) => clamp(y, 0, scene().height - 1)).sort((a, b) => a - b);
    drag.crop = {x: columns[0], y: rows[0], w: columns[1] - columns[0] + 1, h: rows[1] - rows[0] + 1};
    update();
  }
}

function readOut({x, column, row}, pane) {
  if (column < 0 || row < 0 || column >= scene().width || row >= scene().height) return;
  const right = state.mode === "wipe" && x > state.split * pane.canvas.width;
  const number = right ? state.against : pane.number, at = row * scene().width + column;
  const values = [...new Set([number, 0])].filter(entryOf).map((shown) => {
    const image = load(entryOf(shown).pixels, entryOf(shown).exponent);
    if (!image) return "";
    const rgb = [0, 1, 2].map((c) => digits(HALF[image.halves[3 * at + c]] * 2 ** image.exponent));
    return `${nameOf(shown)} ${rgb.join(" ")}`;
  });
  const map = number > 0 && entryOf(number) && mapOf(number);
  if (map) values.push(`${data.labels[state.metric]} ${digits(map[at])}`);
  $("readout").textContent = [`pixel ${column}, ${row}`, ...values].join("  ·  ");
}

// --- keys -----------------------------------------------------------------------------------------------------------

const KEYS = {
  ArrowLeft: () => nextImage(-1), ArrowRight: () => nextImage(1),
  ArrowUp: () => chooseBudget(state.budget + 1), ArrowDown: () => chooseBudget(state.budget - 1),
  w: () => choose({mode: state.mode === "wipe" ? "single" : "wipe"}),
  s: () => choose({mode: state.mode === "grid" ? "single" : "grid"}),
  ",": () => choose({split: clamp(state.split - 0.02, 0, 1)}), ".": () => choose({split: clamp(state.split + 0.02, 0, 1)}),
  e: (event) => expose(own().exposure + (event.shiftKey ? -0.5 : 0.5)), a: exposeByReference,
  f: () => choose({error: !state.error}), "[": () => scaleError(0.5), "]": () => scaleError(2),
  "+": () => zoomBy(1.25), "=": () => zoomBy(1.25), "-": () => zoomBy(0.8),
  Home: () => { own().exposure = 0; wholeImage(); },
  "?": () => { $("help").open = !$("help").open; },
};

// Whether a key belongs to the control that has the focus.
function taken(target, key) {
  if (target.matches("select, textarea, input[type=text]")) return true;
  return target.matches("input") && (key.startsWith("Arrow") || key === "Home");
}

document.addEventListener("keydown", (event) => {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, active = document.activeElement;
  if (event.ctrlKey || event.altKey || event.metaKey || root.hidden || taken(active, key)) return;
  // Without any focus, keys that do not scroll belong to the viewer as long as it can be seen.
  const box = root.getBoundingClientRect(), seen = box.bottom > 0 && box.top < window.innerHeight;
  const free = active === document.body && seen && key.length === 1;
  if (!root.contains(active) && !free) return;
  if (/^[0-9]$/.test(key)) {
    if (Number(key) < count() && entryOf(Number(key))) choose({number: Number(key)});
  } else if (Object.hasOwn(KEYS, key)) {
    KEYS[key](event);
  } else {
    return;
  }
  event.preventDefault();
});

// --- start ----------------------------------------------------------------------------------------------------------

function showMetric(metric) {
  data.shown = metric;
  for (const part of document.querySelectorAll("[data-metric]")) part.hidden = part.dataset.metric !== metric;
  if (data.metrics.includes(metric)) state.metric = metric;
  if (!root.hidden) update();
}

function button(group, value, attributes, ...content) {
  const made = element("button", {...attributes, value}, ...content);
  $(group).append(made);
  return made;
}

function start() {
  $("metric").addEventListener("change", (event) => showMetric(event.target.value));
  root.hidden = data.scenes.length === 0;
  showMetric(data.shown);
  if (root.hidden) return;
  data.scenes.forEach(({name}, i) => button("scenes", i, {}, name).addEventListener("click", () => chooseScene(i)));
  for (let number = 0; number < count(); number++) {
    const key = number < 10 ? [element("kbd", {}, String(number))] : [];
    button("choices", number, {}, ...key, nameOf(number)).addEventListener("click", () => choose({number}));
    $("against").append(element("option", {value: number}, nameOf(number)));
  }
  data.budgets.forEach((label, i) => $("budget").append(element("option", {value: i}, label)));
  data.metrics.forEach((metric) => $("error-metric").append(element("option", {value: metric}, data.labels[metric])));
  for (const one of $("modes").children) one.addEventListener("click", () => choose({mode: one.dataset.mode}));
  $("budget").addEventListener("change", (event) => chooseBudget(Number(event.target.value)));
  $("against").addEventListener("change", (event) => choose({against: Number(event.target.value)}));
  $("split").addEventListener("input", (event) => choose({split: Number(event.target.value)}));
  $("exposure").addEventListener("input", (event) => expose(Number(event.target.value)));
  $("auto").addEventListener("click", exposeByReference);
  $("error").addEventListener("change", (event) => choose({error: event.target.checked}));
  $("error-metric").addEventListener("change", (event) => choose({metric: event.target.value}));
  $("darker").addEventListener("click", () => scaleError(2));
  $("brighter").addEventListener("click", () => scaleError(0.5));
  $("zoom-in").addEventListener("click", () => zoomBy(1.25));
  $("zoom-out").addEventListener("click", () => zoomBy(0.8));
  $("fit").addEventListener("click", wholeImage);
  new ResizeObserver(update).observe(stage);
  const context = $("colours").getContext("2d"), out = context.createImageData(256, 1);
  falseColour(Float32Array.from({length: 256}, (_, i) => i), 255, table, out.data);
  context.putImageData(out, 0, 0);
  state.budget = data.budgets.length - 1;
  chooseScene(0);
}

start();
