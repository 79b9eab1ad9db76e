/* The colour-magnitude diagram: a point for each source, which opens it. */

const MARGIN = { left: 54, right: 14, top: 10, bottom: 42 };
const MAX_TICKS = 7;

/* Multiples of a round step between two numbers. */
function ticksOf(low, high) {
  const raw = (high - low) / MAX_TICKS, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * ([1, 2, 5, 10].find((k) => k * power >= raw) ?? 10);
  const first = Math.ceil(low / step), n = Math.floor(high / step) - first + 1;
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Array.from({ length: n }, (_, k) => [(first + k) * step, ((first + k) * step).toFixed(digits).replace("-", "−")]);
}

class Diagram {
  constructor(view) {
    this.view = view;
    this.canvas = byId("diagram");
    this.bands = magnitudeColumns();
    this.at = -1;  // number of the point under the pointer or chosen by keys
    if (!this.canvas || this.bands.length < 2) { byId("colours")?.setAttribute("hidden", ""); return; }
    const first = Math.max(0, this.bands.length - 3);  // neighbouring bands, mostly of one survey
    for (const [id, k] of [["colour-a", first], ["colour-b", first + 1], ["colour-m", this.bands.length - 1]]) {
      byId(id).append(...this.bands.map(([title, place]) => option(title, place)));
      byId(id).selectedIndex = k;
      byId(id).addEventListener("change", () => this.draw());
    }
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    this.canvas.addEventListener("pointermove", (event) => this.point(this.nearest(event)));
    this.canvas.addEventListener("pointerleave", () => this.point(-1));
    this.canvas.addEventListener("click", (event) => this.open(this.nearest(event)));
    this.canvas.addEventListener("keydown", (event) => this.key(event));
  }

  /* [row, colour, magnitude] of the wanted sources, from left to right. */
  get points() {
    const [a, b, m] = ["colour-a", "colour-b", "colour-m"].map((id) => SOURCES.columns[Number(byId(id).value)]);
    return SOURCES.id.map((_, i) => [i, a[i] === null || b[i] === null ? NaN : a[i] - b[i], m[i] ?? NaN])
      .filter(([i, x, y]) => this.view.wanted[i] && Number.isFinite(x) && Number.isFinite(y))
      .sort((p, q) => p[1] - q[1]);
  }

  draw() {
    if (!this.canvas || this.bands.length < 2) return;
    const { canvas } = this, ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    [canvas.width, canvas.height] = [w * ratio, h * ratio];
    const c = canvas.getContext("2d"), points = this.points;
    c.scale(ratio, ratio);
    const [x, y] = [scaleOf(points.map((p) => p[1])), scaleOf(points.map((p) => p[2]))];
    const inner = [w - MARGIN.left - MARGIN.right, h - MARGIN.top - MARGIN.bottom];
    const right = (v) => MARGIN.left + (v - x[0]) / (x[1] - x[0]) * inner[0];
    const down = (v) => MARGIN.top + (v - y[0]) / (y[1] - y[0]) * inner[1];  // bright ones on top
    this.drawAxes(c, w, h, [ticksOf(...x), right], [ticksOf(...y), down]);
    this.placed = points.map(([i, a, b]) => [i, right(a), down(b), a, b]);
    c.fillStyle = colour("--accent");
    for (const [, u, v] of this.placed) { c.beginPath(); c.arc(u, v, 2.4, 0, 7); c.fill(); }
    const own = this.placed.find(([i]) => i === this.view.chosen), here = this.placed[this.at];
    c.strokeStyle = colour("--ink");
    for (const [one, r] of [[own, 7], [here, 5]]) {
      if (one) { c.lineWidth = 2; c.beginPath(); c.arc(one[1], one[2], r, 0, 7); c.stroke(); }
    }
    root.dataset.points = String(points.length);
  }

  drawAxes(c, w, h, [across, right], [along, down]) {
    const low = h - MARGIN.bottom, end = w - MARGIN.right, name = (id) => byId(id).selectedOptions[0].textContent;
    c.font = "12px system-ui, sans-serif";
    c.lineWidth = 1;
    c.textAlign = "center";
    c.strokeStyle = colour("--line");
    c.fillStyle = colour("--soft");
    for (const [value, text] of across) {
      c.strokeRect(right(value), MARGIN.top, 0, low - MARGIN.top);
      c.fillText(text, right(value), low + 16);
    }
    for (const [value, text] of along) {
      c.strokeRect(MARGIN.left, down(value), end - MARGIN.left, 0);
      c.textAlign = "right";
      c.fillText(text, MARGIN.left - 7, down(value) + 4);
    }
    c.textAlign = "center";
    c.fillStyle = colour("--ink");
    const system = DATA.columns[Number(byId("colour-m").value)].unit;
    c.fillText(`${name("colour-a")} − ${name("colour-b")} [mag]`, (MARGIN.left + end) / 2, h - 8);
    c.save();
    c.translate(14, (MARGIN.top + low) / 2);
    c.rotate(-Math.PI / 2);
    c.fillText(`${name("colour-m")} [${system}]`, 0, 0);
    c.restore();
  }

  nearest(event) {
    const box = this.canvas.getBoundingClientRect(), [u, v] = [event.clientX - box.left, event.clientY - box.top];
    let best = -1, least = 12;
    (this.placed ?? []).forEach(([, a, b], k) => {
      const apart = Math.hypot(a - u, b - v);
      if (apart < least) { best = k; least = apart; }
    });
    return best;
  }

  point(k) {
    if (k === this.at) return;
    this.at = k;
    const one = this.placed?.[k];
    byId("point").textContent = one
      ? `Source ${SOURCES.id[one[0]]}: colour ${formatted(one[3], ".2f")}, magnitude ${formatted(one[4], ".2f")}` : "";
    this.canvas.style.cursor = one ? "pointer" : "default";
    this.draw();
  }

  open(k) {
    const one = this.placed?.[k];
    if (one) location.hash = `source-${SOURCES.id[one[0]]}`;
  }

  key(event) {
    const n = this.placed?.length ?? 0, step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step && n) { event.preventDefault(); this.point((this.at + step + n) % n); }
    if (event.key === "Enter") this.open(this.at);
  }
}

/* Ends of an axis over values, with some room. */
function scaleOf(values) {
  if (!values.length) return [0, 1];
  const low = values.reduce((a, b) => Math.min(a, b)), high = values.reduce((a, b) => Math.max(a, b));
  const room = 0.05 * Math.max(high - low, 0.5);
  return [low - room, high + room];
}
