"use strict";
/* Data of the page; pixel values from their texts, see codes.py. */

const root = document.documentElement;
root.dataset.errors = "0";
const failed = () => { root.dataset.errors = String(Number(root.dataset.errors) + 1); };
for (const kind of ["error", "unhandledrejection", "securitypolicyviolation"]) {
  window.addEventListener(kind, failed);
}
const DATA = JSON.parse(document.getElementById("field-data").textContent);
const SOURCES = DATA.sources;
const STATES = ["ok", "flagged", "failed"];
const LAYERS = ["data", "model", "residual"];
const byId = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
const planes = new Map();  // text -> plane, the last used at the end
const MAX_PLANES = 600;  // of 256 x 256 pixels: some 160 MB

/* Bytes of a deflated base64 text. */
async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/* Values [noise of a pixel] of bytes; NaN without data. */
function decode(bytes, columns, smooth) {
  const n = bytes.length / 2, codes = new Uint16Array(n), values = new Float32Array(n);
  const { knee } = DATA.codes, step = smooth ? DATA.codes.smooth : DATA.codes.noisy;
  for (let i = 0; i < n; i += 1) {
    let code = bytes[i] | (bytes[n + i] << 8);
    if (smooth && i >= columns) code = (code + codes[i - columns]) & 65535;
    codes[i] = code;
    const place = code - 1, steps = place & 1 ? -(place + 1) / 2 : place / 2;
    values[i] = code === 0 ? NaN : knee * Math.sinh(step * steps);
  }
  return values;
}

/* The plane of a text, decoded when first asked for; `then` is called once it is ready. */
function planeOf(text, columns, smooth, then) {
  let plane = planes.get(text);
  if (plane) {
    planes.delete(text);
  } else {
    plane = { ready: false, values: null, waiting: new Set() };
    inflate(text).then((bytes) => {
      plane.values = decode(bytes, columns, smooth);
      plane.ready = true;
      plane.waiting.forEach((call) => call());
      plane.waiting.clear();
    });
  }
  if (!plane.ready) plane.waiting.add(then);
  planes.set(text, plane);
  if (planes.size > MAX_PLANES) planes.delete(planes.keys().next().value);
  return plane;
}

/* Half a step [noise of a pixel]: the largest error of a value. */
function roundingOf(value, smooth) {
  const { knee } = DATA.codes, step = smooth ? DATA.codes.smooth : DATA.codes.noisy;
  return 0.5 * step * Math.hypot(knee, value);
}

/* One channel of a picture: {model, residual, own} texts, its columns, and its unit [counts]. */
class Picture {
  constructor(texts, columns, unit) {
    Object.assign(this, { texts, columns, unit });
  }

  /* Planes that a layer needs; null while one is not decoded. */
  parts(layer, then) {
    const names = { data: ["model", "residual"], alone: ["own", "residual"] }[layer] ?? [layer];
    const found = names.map((name) => planeOf(this.texts[name], this.columns, name !== "residual", then));
    return found.every((plane) => plane.ready) ? found.map((plane) => plane.values) : null;
  }

  /* Values [counts] of a layer: data = model + residual, alone = the own model + residual. */
  counts(layer, then) {
    const parts = this.parts(layer, then);
    return parts && Float32Array.from(parts[0], (v, i) => (parts[1] ? v + parts[1][i] : v) * this.unit);
  }

  /* {value, error} [counts] of one pixel in a layer; null while it is not decoded. */
  at(layer, i, then) {
    const parts = this.parts(layer, then);
    if (!parts) return null;
    const noisy = layer === "residual";
    let value = parts[0][i], error = roundingOf(value, !noisy);
    if (parts[1]) { error += roundingOf(parts[1][i], false); value += parts[1][i]; }
    return { value: value * this.unit, error: error * this.unit };
  }
}

/* The picture of a tile in one channel. */
function tilePicture(instrument, level, k, channel) {
  const texts = { model: level.model[k][channel], residual: level.residual[k][channel] };
  return new Picture(texts, level.places[k][0], instrument.sigma[channel] / level.scale);
}
