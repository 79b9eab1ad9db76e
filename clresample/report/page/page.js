/* Starts the page: choices, pointer and keys of the field, search, links to sources. */

function startView() {
  const canvas = byId("sky"), view = new View(canvas);
  const choose = (row) => { if (row >= 0) location.hash = `source-${SOURCES.id[row]}`; };
  for (const input of document.querySelectorAll("input[name=layer]")) {
    input.addEventListener("change", () => { view.layer = input.value; refresh(view); });
  }
  for (const input of document.querySelectorAll("input[name=instrument]")) {
    input.addEventListener("change", () => { view.instrument = Number(input.value); fillBands(view); refresh(view); });
  }
  for (const [id, name] of [["marks", "marks"], ["labels", "labels"], ["ellipses", "ellipses"], ["outlines", "outlines"]]) {
    byId(id).addEventListener("change", (event) => { view.show[name] = event.target.checked; view.later(); });
  }
  const middle = () => view.size.map((n) => n / 2);
  byId("zoom-in").addEventListener("click", () => view.by(1.6, ...middle()));
  byId("zoom-out").addEventListener("click", () => view.by(1 / 1.6, ...middle()));
  byId("zoom-fit").addEventListener("click", () => view.fit());
  view.changed = () => followLayer(view);
  view.drawn = () => showRamp(view);
  startLook(view);
  startPointer(canvas, view, choose);
  const copy = () => copyText(coordinatesOf(...(view.spot ?? [view.x, view.y])));
  canvas.addEventListener("keydown", (event) => {
    const step = 60, keys = {
      ArrowLeft: () => view.move(-step, 0), ArrowRight: () => view.move(step, 0),
      ArrowUp: () => view.move(0, -step), ArrowDown: () => view.move(0, step),
      "+": () => view.by(1.4, ...middle()), "=": () => view.by(1.4, ...middle()),
      "-": () => view.by(1 / 1.4, ...middle()), "0": () => view.fit(),
      Enter: () => choose(view.nearest(...middle(), Infinity)),
      "1": () => pick("data"), "2": () => pick("model"), "3": () => pick("residual"),
      b: () => compareBy("blink"), s: () => compareBy("layers"), c: copy,
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  byId("save-png").addEventListener("click", () => savePng(view));
  byId("save-fits").addEventListener("click", () => saveField(view));
  byId("save-regions").addEventListener("click", () => saveRegions(view));
  byId("copy").addEventListener("click", copy);
  return view;
}

function pick(layer) {
  document.querySelector(`input[name=layer][value=${layer}]`)?.click();
}

/* Switches a way of comparing on or off. */
function compareBy(way) {
  const select = byId("compare");
  select.value = select.value === way ? "single" : way;
  select.dispatchEvent(new Event("change"));
}

/* Draws again after a choice that changes the limits. */
function refresh(view) {
  view.measured.clear();
  if (view.look.mode === "own" && view.ownOf !== ownKey(view)) { view.look.mode = "auto"; byId("limits").value = "auto"; }
  showLegend(view);
  view.later();
}

const ownKey = (view) => [view.instrument, view.bands[view.instrument], view.layer === "residual"].join();

function fillBands(view) {
  const one = DATA.instruments[view.instrument];
  if (!one) return;
  const three = one.colour.channels.length === 3 ? [option("colour", -1)] : [];
  byId("band").replaceChildren(...three, ...one.channels.map((name, c) => option(name, c)));
  byId("band").value = String(view.bands[view.instrument]);
}

/* Band, comparison, stretch, limits, colours. */
function startLook(view) {
  fillBands(view);
  const follow = (id, act) => byId(id).addEventListener("change", (event) => { act(event.target.value); refresh(view); });
  follow("band", (value) => { view.bands[view.instrument] = Number(value); });
  follow("compare", (value) => {
    const [w, h] = view.size, least = view.zoom <= view.least * 2.001;
    view.compare = value;
    if (least) view.fit();
    else view.zoom *= Math.min(view.size[0] / w, view.size[1] / h);
  });
  follow("stretch", (value) => { view.look.stretch = value; });
  follow("palette", (value) => { view.look.palette = value; });
  follow("limits", (value) => {
    if (value === "own") takeLimits(view);
    view.look.mode = value;
  });
  for (const id of ["low", "high"]) {
    byId(id).addEventListener("change", () => {
      byId("limits").value = "own";
      takeLimits(view);
      view.look.mode = "own";
      refresh(view);
    });
  }
}

function takeLimits(view) {
  const low = Number(byId("low").value), high = Number(byId("high").value);
  view.own = { low, high: high > low ? high : low + 1e-6 };
  view.ownOf = ownKey(view);
}

/* The radio buttons after the layer that is shown while layers blink. */
function followLayer(view) {
  document.querySelector(`input[name=layer][value=${view.layer}]`).checked = true;
  showLegend(view);
}

/* Drag, wheel (once the field has the focus, so that the page can be scrolled past) and pinch. */
function startPointer(canvas, view, choose) {
  const down = new Map();
  let moved = 0;
  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    return view.inPane(event.clientX - box.left, event.clientY - box.top);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, at(event).slice(1));
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const [pane, u, v] = at(event), before = down.get(event.pointerId);
    readOut(view, pane, u, v);
    if (!before) return;
    if (down.size === 1) {
      view.move(before[0] - u, before[1] - v);
      moved += Math.hypot(before[0] - u, before[1] - v);
    } else {
      const other = [...down].find(([id]) => id !== event.pointerId)[1];
      const ratio = Math.hypot(u - other[0], v - other[1]) / Math.hypot(before[0] - other[0], before[1] - other[1]);
      if (Number.isFinite(ratio) && ratio > 0) view.by(ratio, ...other);
      moved += 9;
    }
    down.set(event.pointerId, [u, v]);
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      if (!down.delete(event.pointerId) || kind !== "pointerup" || moved >= 4) return;
      const [, u, v] = at(event);
      choose(view.nearest(u, v));
    });
  }
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    view.by(Math.exp(-0.0016 * event.deltaY), ...at(event).slice(1));
  }, { passive: false });
}

/* Position and values under the pointer: of every channel data, model, residual, with their rounding. */
function readOut(view, pane, u, v) {
  const [x, y] = view.toFrame(u, v), o = DATA.frame.offset, sky = DATA.frame.sky, at = skyAt(x, y);
  const where = at ? `${sky.names[0]} ${at[0].toFixed(5)}°  ${sky.names[1]} ${at[1].toFixed(5)}°  ` : "";
  byId("readout").textContent = `${where}x ${(x + o[1]).toFixed(1)}  y ${(y + o[0]).toFixed(1)}`;
  const one = DATA.instruments[pane.instrument];
  if (!one) return;
  const turn = view.turn = (view.turn ?? 0) + 1;
  const again = () => { if (view.turn === turn) readOut(view, pane, u, v); };
  const found = view.pixelAt(pane.instrument, x, y);
  byId("values").textContent = found ? valuesText(one, found, again) : "outside the image";
}

/* Lines of numbers of one pixel. */
function valuesText(one, { level, k, column, row }, then) {
  const i = row * level.places[k][0] + column, [x0, y0] = level.origins[k];
  const size = level.scale > 1 ? `, means of ${level.scale} x ${level.scale} pixels` : "";
  const lines = [`${one.name} pixel (${x0 + column}, ${y0 + row})${size} [${one.unit}]; ± is the rounding of this page, not the noise`];
  one.channels.forEach((name, channel) => {
    const picture = tilePicture(one, level, k, channel);
    const texts = LAYERS.map((layer) => {
      const pixel = picture.at(layer, i, then);
      return `${layer} ${!pixel ? "…" : Number.isFinite(pixel.value) ? withRounding(pixel) : "none"}`;
    });
    const left = picture.at("residual", i, then);
    const sigmas = left && Number.isFinite(left.value) ? `  (${formatted(left.value / picture.unit, ".1f")} σ)` : "";
    lines.push(`${name.padEnd(6)} ${texts.join("  ")}${sigmas}`);
  });
  return lines.join("\n");
}

/* A value to the digits that its rounding leaves. */
function withRounding({ value, error }) {
  const digits = Math.max(0, Math.min(8, 1 - Math.floor(Math.log10(error))));
  return `${value.toFixed(digits)} ± ${error.toFixed(digits)}`.replaceAll("-", "−");
}

function showLegend(view) {
  const one = DATA.instruments[view.instrument], band = view.bands[view.instrument];
  byId("shown").textContent = !one ? "" : view.layer === "residual"
    ? `${one.name}: ${band < 0 ? `mean residual of ${one.channels.join(", ")}` : `residual in ${one.channels[band]}`}, in units of the noise of a shown pixel`
    : `${one.name}: ${band < 0 ? one.colour.title : one.channels[band]}, ${view.look.stretch}`;
}

/* The colours from low to high, with their values. */
function showRamp(view) {
  const pane = view.panes.find((p) => p.layer === view.layer && p.instrument === view.instrument) ?? view.panes[0];
  const one = DATA.instruments[pane.instrument];
  byId("ramp").hidden = !one;
  if (!one) return;
  const { low, high } = view.limits(pane), unit = pane.layer === "residual" ? "σ" : one.unit;
  byId("ramp-low").textContent = `${formatted(low, ".3g")} ${unit}`;
  byId("ramp-high").textContent = `${formatted(high, ".3g")} ${unit}`;
  for (const [id, value] of [["low", low], ["high", high]]) {
    if (document.activeElement !== byId(id)) byId(id).value = String(Number(value.toPrecision(4)));
  }
  const three = pane.layer !== "residual" && view.bands[pane.instrument] < 0;
  const table = tableOf(pane.layer === "residual" ? "residual" : three ? "grey" : view.look.palette);
  const level = stretchOf(pane.layer === "residual" ? "linear" : view.look.stretch, view.limits(pane));
  const c = byId("ramp-colours").getContext("2d"), image = c.createImageData(150, 1);
  for (let i = 0; i < 150; i += 1) {
    const at = 3 * Math.round(255 * level(low + i / 149 * (high - low)));
    image.data.set([table[at], table[at + 1], table[at + 2], 255], 4 * i);
  }
  c.putImageData(image, 0, 0);
}

/* Degrees of an angle in degrees or sexagesimal; null for none. */
function degreesOf(text, hours) {
  const found = /^([+-]?)(\d+(?:\.\d*)?)(?:[h:d°](\d+(?:\.\d*)?)(?:[m:'′](\d+(?:\.\d*)?)[s"″]?)?[m'′]?)?[°d]?$/.exec(text);
  if (!found) return null;
  const [, sign, whole, minutes, seconds] = found, sexagesimal = minutes !== undefined;
  if ((sexagesimal && Number(minutes) >= 60) || Number(seconds ?? 0) >= 60) return null;
  const value = Number(whole) + Number(minutes ?? 0) / 60 + Number(seconds ?? 0) / 3600;
  return (sign === "-" ? -1 : 1) * value * (hours && sexagesimal ? 15 : 1);
}

/* [RA, Dec] of a text; null for none. */
function positionOf(text) {
  let words = text.trim().replaceAll("−", "-").split(/[\s,]+/);
  if (words.length === 6) words = [words.slice(0, 3).join(":"), words.slice(3).join(":")];
  if (words.length !== 2) return null;
  const equatorial = DATA.frame.sky.names[0] === "RA";
  const [ra, dec] = [degreesOf(words[0], equatorial && !/[d°]/.test(words[0])), degreesOf(words[1], false)];
  return ra === null || dec === null || Math.abs(dec) > 90 || ra < 0 || ra >= 360 ? null : [ra, dec];
}

/* Goes to a source by its id, or to a position; returns the message. */
function search(view, text) {
  const row = ROW_OF.get(text.trim());
  if (row !== undefined) { location.hash = `source-${text.trim()}`; return `Source ${text.trim()}`; }
  if (!DATA.frame.sky) return "no source has this id; this field has no position on the sky";
  const position = positionOf(text), place = position && placeOf(...position);
  if (!position) return "neither the id of a source nor a position, such as 150.01 2.2 or 10:00:02.4 +2:12:00";
  const [ny, nx] = DATA.frame.shape;
  if (!place || place[0] < -0.5 || place[1] < -0.5 || place[0] > nx - 0.5 || place[1] > ny - 0.5) return "this position is outside the field";
  view.spot = place;
  view.go(...place);
  return `${DATA.frame.sky.names.join(", ")} ${position.map((v) => v.toFixed(5)).join(", ")}`;
}

function startTheme(changed) {
  const button = byId("theme"), dark = window.matchMedia("(prefers-color-scheme: dark)");
  const now = () => root.dataset.theme ?? (dark.matches ? "dark" : "light");
  const name = () => { button.textContent = now() === "dark" ? "Light" : "Dark"; changed(); };
  button.addEventListener("click", () => { root.dataset.theme = now() === "dark" ? "light" : "dark"; name(); });
  dark.addEventListener("change", name);
  name();
}

function start() {
  root.dataset.live = "yes";  // shows what works with a script only
  const view = startView(), diagram = new Diagram(view);
  startTheme(() => diagram.draw());
  showLegend(view);
  startTables();
  new SourceTable(view, () => diagram.draw());
  byId("search").addEventListener("submit", (event) => {
    event.preventDefault();
    byId("answer").textContent = search(view, byId("place").value);
  });
  const follow = () => {
    const row = ROW_OF.get(decodeURIComponent(location.hash).replace(/^#source-/, ""));
    if (row === undefined) return;
    showSource(row, view);
    diagram.draw();
    document.querySelector(".viewer").scrollIntoView({ block: "nearest" });
  };
  window.addEventListener("hashchange", follow);
  follow();
}

start();
