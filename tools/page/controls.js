// The controls of the viewer: buttons, mouse, keys; and the choice of the metric that table and plots show.

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
  sortable();
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
