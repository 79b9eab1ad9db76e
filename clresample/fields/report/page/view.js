"use strict";
/* The field: tiles of a pyramid drawn in the frame's pixels, sources marked, moved and zoomed. */

const root = document.documentElement;
root.dataset.errors = "0";
const failed = () => { root.dataset.errors = String(Number(root.dataset.errors) + 1); };
for (const kind of ["error", "unhandledrejection", "securitypolicyviolation"]) {
  window.addEventListener(kind, failed);
}
const DATA = JSON.parse(document.getElementById("field-data").textContent);
const SOURCES = DATA.sources;
const STATES = ["ok", "flagged", "failed"];
const byId = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
const MARK = "#8fc2ff";  // the accent of dark pages: the sky is dark in both
const pictures = new Map();  // text of a tile -> Image, the last used at the end
const MOST_PICTURES = 400;
const MOST_MARKS = 2500;  // at once, the brightest of those in view: more take seconds without a GPU

/* The Image of a base64 text, decoded when first asked for; `then` is called once it is there. */
function picture(text, then) {
  let image = pictures.get(text);
  if (image) {
    pictures.delete(text);
  } else {
    image = new Image();
    image.wanted = new Set();
    image.addEventListener("load", () => {
      image.ready = true;
      image.wanted.forEach((call) => call());
    });
    image.addEventListener("error", failed);
    image.src = "data:image/png;base64," + text;
  }
  if (!image.ready) image.wanted.add(then);
  pictures.set(text, image);
  if (pictures.size > MOST_PICTURES) pictures.delete(pictures.keys().next().value);
  return image;
}

class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.layer = "data";
    this.instrument = 0;
    this.marks = true;
    this.chosen = -1;
    this.waiting = false;
    this.again = () => this.later();
    this.fit();
    new ResizeObserver(this.again).observe(canvas);
  }

  get size() { return [this.canvas.clientWidth || 1, this.canvas.clientHeight || 1]; }

  fit() {
    const [w, h] = this.size, [ny, nx] = DATA.frame.shape;
    this.x = (nx - 1) / 2;
    this.y = (ny - 1) / 2;
    this.zoom = 0.96 * Math.min(w / nx, h / ny);
    this.least = this.zoom / 2;
    this.later();
  }

  later() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  toScreen(x, y) {
    const [w, h] = this.size;
    return [w / 2 + (x - this.x) * this.zoom, h / 2 - (y - this.y) * this.zoom];
  }

  toFrame(u, v) {
    const [w, h] = this.size;
    return [this.x + (u - w / 2) / this.zoom, this.y - (v - h / 2) / this.zoom];
  }

  /* Zoom by a factor about a point of the screen, which stays where it is. */
  by(factor, u, v) {
    const [x, y] = this.toFrame(u, v);
    const zoom = Math.min(Math.max(this.zoom * factor, this.least), 60);
    this.x = x + (this.x - x) * this.zoom / zoom;
    this.y = y + (this.y - y) * this.zoom / zoom;
    this.zoom = zoom;
    this.later();
  }

  move(u, v) {
    const [ny, nx] = DATA.frame.shape;
    this.x = Math.min(Math.max(this.x + u / this.zoom, 0), nx);
    this.y = Math.min(Math.max(this.y - v / this.zoom, 0), ny);
    this.later();
  }

  /* Bring a place into the middle, so large that a source is seen. */
  go(x, y) {
    [this.x, this.y] = [x, y];
    this.zoom = Math.max(this.zoom, 4);
    this.later();
  }

  draw() {
    const { canvas, context: c } = this, [w, h] = this.size, ratio = window.devicePixelRatio || 1;
    const [pw, ph] = [Math.round(w * ratio), Math.round(h * ratio)];
    if (canvas.width !== pw || canvas.height !== ph) { canvas.width = pw; canvas.height = ph; }
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colour("--sky");
    c.fillRect(0, 0, pw, ph);
    const [tiles, missing] = this.drawTiles(ratio);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const marks = this.marks ? this.drawMarks() : 0;
    this.drawScale();
    root.dataset.drawn = missing ? "waiting" : `${tiles} tiles, ${marks} marks`;
  }

  /* The coarsest level below, so that nothing is empty while finer tiles are decoded. */
  drawTiles(ratio) {
    const levels = DATA.instruments[this.instrument]?.levels ?? [];
    const fine = (level) => {
      const [, , a, b] = level.places[0] ?? [1, 1, 1, 0];
      return Math.hypot(a, b) * this.zoom * ratio;  // device pixels of one pixel of the level
    };
    let i = levels.length - 1;
    while (i > 0 && fine(levels[i]) > 1.3) i -= 1;
    const counts = [0, 0];
    for (const level of new Set([levels.length - 1, i])) {
      if (levels[level]) this.drawLevel(levels[level], fine(levels[level]), ratio, counts);
    }
    return counts;
  }

  drawLevel(level, side, ratio, counts) {
    const c = this.context, [w, h] = this.size;
    c.imageSmoothingEnabled = side < 2;
    level.places.forEach((place, k) => {
      const [n, m, a, b, cx, cy, x, y] = place;
      const corners = [[0, 0], [n, 0], [0, m], [n, m]].map(
        ([u, v]) => this.toScreen(a * u + cx * v + x, b * u + cy * v + y));
      const us = corners.map((p) => p[0]), vs = corners.map((p) => p[1]);
      if (Math.max(...us) < 0 || Math.min(...us) > w || Math.max(...vs) < 0 || Math.min(...vs) > h) return;
      const image = picture(level[this.layer][k], this.again);
      if (!image.ready) { counts[1] += 1; return; }
      const [ox, oy] = this.toScreen(0, 0), z = this.zoom, more = 0.4 / side;
      c.setTransform(z * ratio, 0, 0, -z * ratio, ox * ratio, oy * ratio);
      c.transform(a, b, cx, cy, x, y);
      c.drawImage(image, -more, -more, n + 2 * more, m + 2 * more);
      counts[0] += 1;
    });
  }

  drawMarks() {
    const c = this.context, [w, h] = this.size, r = Math.min(Math.max(4 * this.zoom, 5), 15);
    const paths = STATES.map(() => new Path2D()), seen = [];
    for (const wanted of [(state) => state === 2, (state) => state !== 2]) {  // failed ones first
      for (let i = 0; i < SOURCES.x.length && seen.length < MOST_MARKS; i += 1) {
        if (!wanted(SOURCES.state[i])) continue;
        const [u, v] = this.toScreen(SOURCES.x[i], SOURCES.y[i]);
        if (u > -r && v > -r && u < w + r && v < h + r) seen.push([SOURCES.state[i], u, v]);
      }
    }
    for (const [state, u, v] of seen) {
      const path = paths[state];
      if (state === 0) { path.moveTo(u + r, v); path.arc(u, v, r, 0, 7); }
      else if (state === 1) path.rect(u - r, v - r, 2 * r, 2 * r);
      else { path.moveTo(u - r, v - r); path.lineTo(u + r, v + r); path.moveTo(u - r, v + r); path.lineTo(u + r, v - r); }
    }
    for (const [style, width] of [["#000a", 2.6], [MARK, 1.2]]) {
      c.strokeStyle = style;
      c.lineWidth = width;
      for (const path of paths) c.stroke(path);
    }
    if (this.chosen >= 0) {
      const [u, v] = this.toScreen(SOURCES.x[this.chosen], SOURCES.y[this.chosen]);
      c.strokeStyle = "#fff";
      c.lineWidth = 2;
      c.beginPath();
      c.arc(u, v, r + 5, 0, 7);
      c.stroke();
    }
    return seen.length;
  }

  drawScale() {
    const known = DATA.frame.scale !== null;  // else lengths are in the frame's pixels
    const each = (known ? DATA.frame.scale : 1) / this.zoom;  // of a screen pixel
    const power = 10 ** Math.floor(Math.log10(130 * each));
    const length = [5, 2, 1].map((k) => k * power).find((s) => s <= 130 * each) ?? power;
    const [value, unit] = !known ? [length, " px"] : length >= 60 ? [length / 60, "′"] : [length, "″"];
    byId("scale-bar").style.width = `${length / each}px`;
    byId("scale-text").textContent = `${+value.toPrecision(2)}${unit}`;
  }

  /* The source nearest to a point of the screen, within some pixels; -1 for none. */
  nearest(u, v, within = 16) {
    let best = -1, least = within;
    for (let i = 0; i < SOURCES.x.length; i += 1) {
      const [a, b] = this.toScreen(SOURCES.x[i], SOURCES.y[i]);
      const apart = Math.hypot(a - u, b - v);
      if (apart < least) { best = i; least = apart; }
    }
    return best;
  }
}
