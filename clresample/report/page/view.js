/* The field: tiles of a pyramid drawn in the frame's pixels, in one pane or several, moved and zoomed. */

const MAX_TILES = 240;  // painted, kept for the next drawing
const SAMPLE = 20000;  // pixels of the view that limits follow
const BLINK_MS = 800;

class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.layer = "data";
    this.instrument = 0;
    this.bands = DATA.instruments.map((one) => (one.colour.channels.length === 3 ? -1 : 0));
    this.compare = "single";
    this.look = { stretch: "asinh", palette: "grey", mode: "auto" };
    this.measured = new Map();  // limits of the view, by instrument, band and layer
    this.own = null;  // limits that the user gave
    this.show = { marks: true, labels: false, ellipses: false, outlines: false };
    this.wanted = SOURCES.id.map(() => true);
    this.chosen = -1;
    this.spot = null;  // a position that was searched for
    this.waiting = false;
    this.tiles = new Map();
    this.again = () => this.later();
    this.fit();
    new ResizeObserver(this.again).observe(canvas);
    window.setInterval(() => this.blink(), BLINK_MS);
  }

  /* Panes [CSS px]: layer, instrument, and where on the canvas. */
  get panes() {
    const w = this.canvas.clientWidth || 1, h = this.canvas.clientHeight || 1;
    const every = this.compare === "layers" ? LAYERS.map((layer) => [layer, this.instrument])
      : this.compare === "instruments" && DATA.instruments.length ? DATA.instruments.map((_, i) => [this.layer, i])
        : [[this.layer, this.instrument]];
    const n = every.length, wide = w >= h;
    return every.map(([layer, instrument], k) => ({
      layer, instrument, alone: n === 1,
      left: wide ? k * w / n : 0, top: wide ? 0 : k * h / n, width: wide ? w / n : w, height: wide ? h : h / n,
    }));
  }

  get size() {
    const [pane] = this.panes;
    return [pane.width, pane.height];
  }

  /* The pane under a point of the canvas, and the point in it. */
  inPane(u, v) {
    const pane = this.panes.find((p) => u < p.left + p.width && v < p.top + p.height) ?? this.panes.at(-1);
    return [pane, u - pane.left, v - pane.top];
  }

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

  blink() {
    if (this.compare !== "blink" || document.hidden) return;
    this.layer = LAYERS[(LAYERS.indexOf(this.layer) + 1) % LAYERS.length];
    this.changed?.();
    this.later();
  }

  toScreen(x, y) {
    const [w, h] = this.size;
    return [w / 2 + (x - this.x) * this.zoom, h / 2 - (y - this.y) * this.zoom];
  }

  toFrame(u, v) {
    const [w, h] = this.size;
    return [this.x + (u - w / 2) / this.zoom, this.y - (v - h / 2) / this.zoom];
  }

  /* Zoom by a factor about a point of a pane, which stays where it is. */
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

  /* Channels shown of an instrument, and their factors. */
  channels(i) {
    const one = DATA.instruments[i], band = this.bands[i];
    return band < 0 ? [one.colour.channels, one.colour.balance] : [[band], [1]];
  }

  pictures(i, level, k, layer) {
    const one = DATA.instruments[i];
    // the residual of a colour picture is that of all channels
    const [few, balance] = layer === "residual" && this.bands[i] < 0
      ? [one.channels.map((_, c) => c), one.channels.map(() => 1)] : this.channels(i);
    return [few.map((c) => tilePicture(one, level, k, c)), balance];
  }

  /* {low, high, knee} of a pane. */
  limits(pane) {
    const base = noiseLimits(DATA.instruments[pane.instrument], this.bands[pane.instrument], pane.layer);
    if (this.look.mode === "auto") return base;
    if (this.look.mode === "own") return { ...base, ...this.own };
    const key = [pane.instrument, this.bands[pane.instrument], pane.layer === "residual"].join();
    if (!this.measured.has(key)) {
      const found = this.measure(pane);
      if (!found) return base;
      this.measured.set(key, found);
    }
    const [low, high] = this.measured.get(key);
    return { low, high: Math.max(high, low + 1e-9 * Math.abs(low)), knee: base.knee };
  }

  /* Limits by the pixels in view; null while some are not decoded. */
  measure(pane) {
    const layer = pane.layer === "residual" ? "residual" : "data";
    const level = this.levelFor(pane.instrument), lights = [];
    if (!level) return [0, 1];
    for (const k of this.visible(level)) {
      const [pictures, balance] = this.pictures(pane.instrument, level, k, layer);
      const found = lightOf(pictures, layer, balance, this.again);
      if (!found) return null;
      lights.push([found.light, this.affine(level.places[k]), level.places[k][0]]);
    }
    const total = lights.reduce((sum, [light]) => sum + light.length, 0), step = Math.max(1, Math.floor(total / SAMPLE));
    const values = [], [w, h] = this.size;
    for (const [light, at, columns] of lights) {
      for (let i = 0; i < light.length; i += step) {
        const [u, v] = at(i % columns + 0.5, Math.floor(i / columns) + 0.5);
        if (u >= 0 && v >= 0 && u < w && v < h && Number.isFinite(light[i])) values.push(light[i]);
      }
    }
    if (!values.length) return [0, 1];
    if (this.look.mode === "zscale") return zscale(values);
    return [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  }

  draw() {
    const { canvas, context: c } = this, ratio = window.devicePixelRatio || 1;
    const [pw, ph] = [Math.round((canvas.clientWidth || 1) * ratio), Math.round((canvas.clientHeight || 1) * ratio)];
    if (canvas.width !== pw || canvas.height !== ph) { canvas.width = pw; canvas.height = ph; }
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colour("--sky");
    c.fillRect(0, 0, pw, ph);
    const counts = [0, 0];
    let marks = 0;
    for (const pane of this.panes) {
      c.save();
      c.setTransform(ratio, 0, 0, ratio, 0, 0);
      c.beginPath();
      c.rect(pane.left, pane.top, pane.width, pane.height);
      c.clip();
      this.drawTiles(pane, ratio, counts);
      c.setTransform(ratio, 0, 0, ratio, pane.left * ratio, pane.top * ratio);
      marks = drawOverlays(this, c, pane);
      c.restore();
    }
    drawScale(this);
    this.drawn?.();
    root.dataset.drawn = counts[1] ? "waiting" : `${counts[0]} tiles, ${marks} marks`;
  }

  /* Device pixels of one pixel of a level. */
  fineness(level) {
    const [, , a, b] = level.places[0] ?? [1, 1, 1, 0];
    return Math.hypot(a, b) * this.zoom * (window.devicePixelRatio || 1);
  }

  levelFor(instrument) {
    const levels = DATA.instruments[instrument]?.levels ?? [];
    let i = levels.length - 1;
    while (i > 0 && this.fineness(levels[i]) > 1.3) i -= 1;
    return levels[i];
  }

  /* A function from (column, row) of a tile to its pane [CSS px]. */
  affine([, , a, b, cx, cy, x, y]) {
    return (u, v) => this.toScreen(a * u + cx * v + x, b * u + cy * v + y);
  }

  /* Numbers of a level's tiles that are in view. */
  visible(level) {
    const [w, h] = this.size;
    return level.places.map((_, k) => k).filter((k) => {
      const [n, m] = level.places[k], at = this.affine(level.places[k]);
      const corners = [[0, 0], [n, 0], [0, m], [n, m]].map(([u, v]) => at(u, v));
      const us = corners.map((p) => p[0]), vs = corners.map((p) => p[1]);
      return Math.max(...us) >= 0 && Math.min(...us) <= w && Math.max(...vs) >= 0 && Math.min(...vs) <= h;
    });
  }

  /* The coarsest level below, so that nothing is empty while finer tiles are decoded. */
  drawTiles(pane, ratio, counts) {
    const fine = this.levelFor(pane.instrument);
    if (!fine) return;
    const look = { ...this.look, limits: this.limits(pane) };
    for (const level of new Set([DATA.instruments[pane.instrument].levels.at(-1), fine])) {
      this.drawLevel(pane, level, look, ratio, counts);
    }
  }

  drawLevel(pane, level, look, ratio, counts) {
    const c = this.context, side = this.fineness(level);
    c.imageSmoothingEnabled = side < 2;
    for (const k of this.visible(level)) {
      const [n, m, a, b, cx, cy, x, y] = level.places[k];
      const tile = this.tile(pane, level, k, look);
      if (!tile) { counts[1] += 1; continue; }
      const [ox, oy] = this.toScreen(0, 0), z = this.zoom, more = 0.4 / side;
      c.setTransform(z * ratio, 0, 0, -z * ratio, (ox + pane.left) * ratio, (oy + pane.top) * ratio);
      c.transform(a, b, cx, cy, x, y);
      c.drawImage(tile, -more, -more, n + 2 * more, m + 2 * more);
      counts[0] += 1;
    }
  }

  /* The canvas of a tile, painted when first needed; null while it is not decoded. */
  tile(pane, level, k, look) {
    const { stretch, palette, limits } = look;
    const key = [pane.instrument, this.bands[pane.instrument], pane.layer, level.scale, k, stretch, palette, ...Object.values(limits)].join();
    let found = this.tiles.get(key);
    if (found) {
      this.tiles.delete(key);
    } else {
      const [pictures, balance] = this.pictures(pane.instrument, level, k, pane.layer), [n, m] = level.places[k];
      found = painted(pictures, pane.layer, balance, look, n, m, this.again);
      if (!found) return null;
    }
    this.tiles.set(key, found);
    if (this.tiles.size > MAX_TILES) this.tiles.delete(this.tiles.keys().next().value);
    return found;
  }

  /* The pixel of an instrument at a place of the frame: {level, k, column, row}; null for none. */
  pixelAt(instrument, x, y) {
    const level = this.levelFor(instrument);
    for (let k = 0; k < (level?.places.length ?? 0); k += 1) {
      const [n, m, a, b, cx, cy, x0, y0] = level.places[k], det = a * cy - b * cx;
      const u = (cy * (x - x0) - cx * (y - y0)) / det, v = (a * (y - y0) - b * (x - x0)) / det;
      if (u >= 0 && v >= 0 && u < n && v < m) return { level, k, column: Math.floor(u), row: Math.floor(v) };
    }
    return null;
  }

  /* The source nearest to a point of a pane, within some pixels; -1 for none. */
  nearest(u, v, within = 16) {
    let best = -1, least = within;
    for (let i = 0; i < SOURCES.x.length; i += 1) {
      if (!this.wanted[i]) continue;
      const [a, b] = this.toScreen(SOURCES.x[i], SOURCES.y[i]);
      const apart = Math.hypot(a - u, b - v);
      if (apart < least) { best = i; least = apart; }
    }
    return best;
  }
}
