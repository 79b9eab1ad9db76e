/* What starts the page: choices, pointer and keys of the field, links to sources, sorted tables. */

function startView() {
  const canvas = byId("sky");
  const view = new View(canvas);
  const choose = (row) => { if (row >= 0) location.hash = `source-${SOURCES.id[row]}`; };
  for (const input of document.querySelectorAll("input[name=layer]")) {
    input.addEventListener("change", () => { view.layer = input.value; showLegend(view); view.later(); });
  }
  for (const input of document.querySelectorAll("input[name=instrument]")) {
    input.addEventListener("change", () => { view.instrument = Number(input.value); showLegend(view); view.later(); });
  }
  byId("marks").addEventListener("change", (event) => { view.marks = event.target.checked; view.later(); });
  const middle = () => view.size.map((n) => n / 2);
  byId("zoom-in").addEventListener("click", () => view.by(1.6, ...middle()));
  byId("zoom-out").addEventListener("click", () => view.by(1 / 1.6, ...middle()));
  byId("zoom-fit").addEventListener("click", () => view.fit());
  startPointer(canvas, view, choose);
  canvas.addEventListener("keydown", (event) => {
    const step = 60, keys = {
      ArrowLeft: () => view.move(-step, 0), ArrowRight: () => view.move(step, 0),
      ArrowUp: () => view.move(0, -step), ArrowDown: () => view.move(0, step),
      "+": () => view.by(1.4, ...middle()), "=": () => view.by(1.4, ...middle()),
      "-": () => view.by(1 / 1.4, ...middle()), "0": () => view.fit(),
      Enter: () => choose(view.nearest(...middle(), Infinity)),
      "1": () => pick("data"), "2": () => pick("model"), "3": () => pick("residual"),
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  return view;
}

function pick(layer) {
  const input = document.querySelector(`input[name=layer][value=${layer}]`);
  if (input) input.click();
}

/* Drag, wheel (once the field has the focus, so that the page can be scrolled past) and pinch. */
function startPointer(canvas, view, choose) {
  const down = new Map();
  let moved = 0;
  const at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, at(event));
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const [u, v] = at(event), before = down.get(event.pointerId);
    readOut(view, u, v);
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
      if (down.delete(event.pointerId) && kind === "pointerup" && moved < 4) choose(view.nearest(...at(event)));
    });
  }
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    view.by(Math.exp(-0.0016 * event.deltaY), ...at(event));
  }, { passive: false });
}

/* Right ascension and declination by a tangent plane through the frame's middle. */
function skyAt(x, y) {
  const sky = DATA.frame.sky;
  if (!sky) return "";
  const rad = Math.PI / 180, [nx, ny] = [x - sky.x, y - sky.y];
  const north = (sky.m[0][0] * ny + sky.m[0][1] * nx) / 3600 * rad;
  const east = (sky.m[1][0] * ny + sky.m[1][1] * nx) / 3600 * rad;
  const d0 = sky.dec * rad, below = Math.cos(d0) - north * Math.sin(d0);
  const ra = sky.ra + Math.atan2(east, below) / rad;
  const dec = Math.atan2(Math.sin(d0) + north * Math.cos(d0), Math.hypot(east, below)) / rad;
  return `${sky.names[0]} ${((ra + 360) % 360).toFixed(5)}°  ${sky.names[1]} ${dec.toFixed(5)}°`;
}

function readOut(view, u, v) {
  const [x, y] = view.toFrame(u, v), o = DATA.frame.offset;
  byId("readout").textContent = `${skyAt(x, y)}  x ${(x + o[1]).toFixed(1)}  y ${(y + o[0]).toFixed(1)}`;
}

function showLegend(view) {
  const one = DATA.instruments[view.instrument];
  byId("ramp-residual").hidden = view.layer !== "residual";
  byId("shown").textContent = !one ? "" : view.layer === "residual"
    ? `${one.name}: mean residual of ${one.channels.join(", ")}, in units of the noise of a shown pixel`
    : `${one.name}: ${one.colours}`;
}

function startTables() {
  for (const table of document.querySelectorAll("table[data-sort]")) {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    const key = (row, i) => {
      const text = row.cells[i].textContent.replace("−", "-"), number = Number.parseFloat(text);
      return Number.isNaN(number) ? [1, 0, text] : [0, number, text];
    };
    heads.forEach((head, i) => {
      const button = made("button", { type: "button" }, ...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const up = head.getAttribute("aria-sort") === "descending" ? 1 : -1;
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", up > 0 ? "ascending" : "descending");
        const rows = [...body.rows].map((row) => [key(row, i), row]);
        rows.sort(([a], [b]) => a[0] - b[0] || up * (a[1] - b[1]) || up * a[2].localeCompare(b[2]));
        body.append(...rows.map(([, row]) => row));
      });
    });
  }
  for (const cell of document.querySelectorAll("[data-source]")) {
    const row = ROW_OF.get(cell.textContent);
    if (row !== undefined) cell.replaceChildren(sourceLink(row));
  }
}

function startTheme() {
  const button = byId("theme"), dark = window.matchMedia("(prefers-color-scheme: dark)");
  const now = () => root.dataset.theme ?? (dark.matches ? "dark" : "light");
  const name = () => { button.textContent = now() === "dark" ? "Light" : "Dark"; };
  button.addEventListener("click", () => { root.dataset.theme = now() === "dark" ? "light" : "dark"; name(); });
  dark.addEventListener("change", name);
  name();
}

function start() {
  root.dataset.live = "yes";  // shows what works with a script only
  startTheme();
  const view = startView();
  showLegend(view);
  startTables();
  const follow = () => {
    const row = ROW_OF.get(decodeURIComponent(location.hash).replace(/^#source-/, ""));
    if (row === undefined) return;
    showSource(row, view);
    document.querySelector(".viewer").scrollIntoView({ block: "nearest" });
  };
  window.addEventListener("hashchange", follow);
  follow();
}

start();
