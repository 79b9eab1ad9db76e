/* Marks drawn over the field: sources, ids, ellipses, outlines of blends, the scale. */

const MARK = "#8fc2ff";  // the accent of dark pages: the sky is dark in both
const MAX_MARKS = 2500;  // at once, the brightest of those in view: more take seconds without a GPU
const MAX_LABELS = 150;
const MIN_OUTLINE_PX = 9;  // [CSS px] half the width of a blend's outline about each source

function strokeTwice(c, path, style = MARK, width = 1.2) {
  for (const [s, w] of [["#000a", width + 1.4], [style, width]]) {
    c.strokeStyle = s;
    c.lineWidth = w;
    c.stroke(path);
  }
}

/* Draws the marks over a pane; returns the number of marked sources. */
function drawOverlays(view, c, pane) {
  const seen = sourcesInView(view);
  if (view.show.outlines) strokeTwice(c, outlinesOf(view, seen), "#ffd479");
  if (view.show.ellipses) strokeTwice(c, ellipsesOf(view, seen), "#9ff0b0");
  if (view.show.marks) drawMarks(view, c, seen);
  if (view.show.labels) drawLabels(c, seen.slice(0, MAX_LABELS));
  if (view.chosen >= 0) drawRing(view, c, SOURCES.x[view.chosen], SOURCES.y[view.chosen]);
  if (view.spot) drawCross(view, c);
  if (!pane.alone) drawTitle(c, pane);
  return view.show.marks ? seen.length : 0;
}

const radiusOf = (view) => Math.min(Math.max(4 * view.zoom, 5), 15);

/* [row, u, v] of the sources in view, failed ones first, then the brightest. */
function sourcesInView(view) {
  const [w, h] = view.size, r = radiusOf(view), seen = [];
  for (const failedOnes of [true, false]) {
    for (let i = 0; i < SOURCES.x.length && seen.length < MAX_MARKS; i += 1) {
      if (!view.wanted[i] || (SOURCES.state[i] === 2) !== failedOnes) continue;
      const [u, v] = view.toScreen(SOURCES.x[i], SOURCES.y[i]);
      if (u > -r && v > -r && u < w + r && v < h + r) seen.push([i, u, v]);
    }
  }
  return seen;
}

function drawMarks(view, c, seen) {
  const path = new Path2D(), r = radiusOf(view);
  for (const [i, u, v] of seen) {
    const state = SOURCES.state[i];
    if (state === 0) { path.moveTo(u + r, v); path.arc(u, v, r, 0, 7); }
    else if (state === 1) path.rect(u - r, v - r, 2 * r, 2 * r);
    else { path.moveTo(u - r, v - r); path.lineTo(u + r, v + r); path.moveTo(u - r, v + r); path.lineTo(u + r, v - r); }
  }
  strokeTwice(c, path);
}

function drawLabels(c, seen) {
  c.font = "11px system-ui, sans-serif";
  for (const [i, u, v] of seen) {
    c.strokeStyle = "#000c";
    c.lineWidth = 3;
    c.strokeText(SOURCES.id[i], u + 9, v - 8);
    c.fillStyle = "#f2f4f8";
    c.fillText(SOURCES.id[i], u + 9, v - 8);
  }
}

function drawRing(view, c, x, y) {
  const [u, v] = view.toScreen(x, y);
  c.strokeStyle = "#fff";
  c.lineWidth = 2;
  c.beginPath();
  c.arc(u, v, radiusOf(view) + 5, 0, 7);
  c.stroke();
}

function drawCross(view, c) {
  const [u, v] = view.toScreen(...view.spot), path = new Path2D();
  for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { path.moveTo(u + 6 * a, v + 6 * b); path.lineTo(u + 18 * a, v + 18 * b); }
  strokeTwice(c, path, "#fff", 1.6);
}

function drawTitle(c, pane) {
  const layer = pane.layer[0].toUpperCase() + pane.layer.slice(1);
  c.font = "600 13px system-ui, sans-serif";
  c.lineWidth = 3;
  c.strokeStyle = "#000c";
  c.fillStyle = "#f2f4f8";
  const words = `${DATA.instruments[pane.instrument]?.name ?? ""} ${layer}`, [x, y] = [10, pane.height - 58];
  c.strokeText(words, x, y);
  c.fillText(words, x, y);
  c.strokeStyle = "#f2f4f866";
  c.lineWidth = 1;
  c.strokeRect(-0.5, -0.5, pane.width, pane.height);
}

/* Half-axes of a source's ellipse as steps of the frame's (x, y): twice its size; null where unknown. */
function axesOf(i) {
  const size = SOURCES.size[i], [e1, e2] = [SOURCES.e1[i] ?? 0, SOURCES.e2[i] ?? 0], m = DATA.frame.axes;
  if (!(size > 0) || !m) return null;
  const e = Math.min(Math.hypot(e1, e2), 1), angle = Math.atan2(e2, e1) / 2;
  const det = m[0][0] * m[1][1] - m[0][1] * m[1][0];
  const step = (north, east) => [(m[0][0] * east - m[1][0] * north) / det, (m[1][1] * north - m[0][1] * east) / det];
  const [a, b] = [2 * size * Math.sqrt(1 + e), 2 * size * Math.sqrt(1 - e)];
  const [n, t] = [Math.cos(angle), Math.sin(angle)];
  return [step(a * n, a * t), step(-b * t, b * n)];
}

/* Points of the screen about a source: its ellipse, or a circle. */
function around(view, i, least) {
  const axes = axesOf(i), points = [], [u, v] = view.toScreen(SOURCES.x[i], SOURCES.y[i]);
  for (let k = 0; k < 24; k += 1) {
    const c = Math.cos(Math.PI * k / 12), s = Math.sin(Math.PI * k / 12);
    let [dx, dy] = axes ? [c * axes[0][0] + s * axes[1][0], c * axes[0][1] + s * axes[1][1]] : [0, 0];
    [dx, dy] = [dx * view.zoom, -dy * view.zoom];
    const length = Math.hypot(dx, dy);
    if (length < least) [dx, dy] = length > 0 ? [dx * least / length, dy * least / length] : [c * least, s * least];
    points.push([u + dx, v + dy]);
  }
  return points;
}

function closed(path, points) {
  points.forEach(([u, v], k) => (k ? path.lineTo(u, v) : path.moveTo(u, v)));
  path.closePath();
}

function ellipsesOf(view, seen) {
  const path = new Path2D();
  for (const [i] of seen) if (axesOf(i)) closed(path, around(view, i, 0));
  return path;
}

/* Convex hulls about the sources of each blend that has several. */
function outlinesOf(view, seen) {
  const path = new Path2D();
  for (const parent of new Set(seen.map(([i]) => SOURCES.parent[i]))) {
    const members = BLENDS.get(parent) ?? [];
    if (members.length > 1) closed(path, hullOf(members.flatMap((i) => around(view, i, MIN_OUTLINE_PX))));
  }
  return path;
}

/* The convex hull of points, by a sweep from left to right and back. */
function hullOf(points) {
  const sorted = [...points].sort((p, q) => p[0] - q[0] || p[1] - q[1]);
  const half = (list) => {
    const found = [];
    for (const p of list) {
      while (found.length > 1) {
        const [a, b] = [found.at(-2), found.at(-1)];
        if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
        found.pop();
      }
      found.push(p);
    }
    return found.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

const BLENDS = new Map();  // parent -> rows of its sources
SOURCES.parent.forEach((parent, i) => {
  if (!BLENDS.has(parent)) BLENDS.set(parent, []);
  BLENDS.get(parent).push(i);
});

function drawScale(view) {
  const known = DATA.frame.scale !== null;  // else lengths are in the frame's pixels
  const each = (known ? DATA.frame.scale : 1) / view.zoom;  // of a screen pixel
  const power = 10 ** Math.floor(Math.log10(130 * each));
  const length = [5, 2, 1].map((k) => k * power).find((s) => s <= 130 * each) ?? power;
  const [value, unit] = !known ? [length, " px"] : length >= 60 ? [length / 60, "′"] : [length, "″"];
  byId("scale-bar").style.width = `${length / each}px`;
  byId("scale-text").textContent = `${+value.toPrecision(2)}${unit}`;
}
