/* One source: its pictures in every channel, what was measured, its neighbours in the blend. */

const ROW_OF = new Map(SOURCES.id.map((id, i) => [id, i]));

/* An element with a class, a text and children; texts are never read as HTML. */
function made(kind, { text, name, ...rest } = {}, ...children) {
  const element = document.createElement(kind);
  if (text !== undefined) element.textContent = text;
  if (name) element.className = name;
  for (const [key, value] of Object.entries(rest)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function sourceLink(row) {
  return made("a", { text: SOURCES.id[row], href: `#source-${SOURCES.id[row]}` });
}

/* Draw one picture: `part` 0 and 1 are halves of the sky's picture, 2 is the residual. */
function drawStamp(canvas, row, part, box, own) {
  const side = 120 * Math.min(window.devicePixelRatio || 1, 2);
  canvas.width = canvas.height = side;
  const c = canvas.getContext("2d"), [x0, y0, n] = box, k = side / n, [w, h] = row.size;
  const paint = () => {
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colour("--sky");
    c.fillRect(0, 0, side, side);
    c.imageSmoothingEnabled = false;
    c.setTransform(k, 0, 0, -k, (0.5 - x0) * k, side - (0.5 - y0) * k);
    c.transform(...row.place);
    c.drawImage(image, part === 1 ? w : 0, 0, w, h, 0, 0, w, h);
    c.setTransform(1, 0, 0, 1, 0, 0);
    for (let i = 0; i < SOURCES.x.length; i += 1) {
      const u = (SOURCES.x[i] - x0 + 0.5) * k, v = side - (SOURCES.y[i] - y0 + 0.5) * k;
      if (u < 0 || v < 0 || u > side || v > side) continue;
      c.strokeStyle = i === own ? "#fff" : MARK;
      c.lineWidth = i === own ? 1.6 : 1;
      const r = 0.05 * side, gap = 0.4 * r;
      c.beginPath();
      for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        c.moveTo(u + a * gap, v + b * gap);
        c.lineTo(u + a * r, v + b * r);
      }
      c.stroke();
    }
    root.dataset.stamps = String(Number(root.dataset.stamps) + 1);
  };
  const image = picture(part === 2 ? row.left : row.sky, paint);
  if (image.ready) paint();
}

function stampsOf(row, stamps) {
  const grid = made("div", { name: "stamps" });
  grid.append(made("span"), ...["Data", "Model", "Residual"].map((text) => made("span", { text })));
  root.dataset.stamps = "0";
  for (const one of stamps.rows) {
    grid.append(made("b", { text: one.name }));
    ["data", "model", "residual"].forEach((what, part) => {
      const canvas = made("canvas", { role: "img", "aria-label": `${what} in ${one.name}` });
      grid.append(canvas);
      drawStamp(canvas, one, part, stamps.box, row);
    });
  }
  return grid;
}

function factsOf(pairs) {
  const list = made("dl", { name: "facts" });
  for (const [what, text] of pairs) list.append(made("dt", { text: what }), made("dd", { text }));
  return list;
}

function fluxTable(rows) {
  const names = DATA.flux_columns;
  const head = made("tr", {}, ...names.map((text, i) => made("th", { text, scope: "col", name: i ? "n" : "" })));
  const body = rows.map((row) => made("tr", {}, ...row.map((text, i) => made("td", { text, name: i ? "n" : "" }))));
  const table = made("table", {}, made("thead", {}, head), made("tbody", {}, ...body));
  return made("div", { name: "scroll" }, table);
}

function membersOf(row) {
  const parent = SOURCES.parent[row], rows = [];
  SOURCES.parent.forEach((p, i) => { if (p === parent && i !== row) rows.push(i); });
  return rows;
}

/* Show a source in the panel. */
function showSource(row, view) {
  const panel = byId("source"), details = DATA.details[row];
  const title = made("h3", { text: `Source ${SOURCES.id[row]}`, tabindex: "-1" });
  const steps = made("div", { name: "steps" });
  for (const [text, to] of [["← Brighter", row - 1], ["Fainter →", row + 1]]) {
    const button = made("button", { text, type: "button" });
    button.disabled = !(to in SOURCES.id);
    button.addEventListener("click", () => { location.hash = `source-${SOURCES.id[to]}`; });
    steps.append(button);
  }
  panel.replaceChildren(title, steps);
  if (details?.stamps) {
    panel.append(stampsOf(row, details.stamps));
    const side = (details.stamps.box[2] * DATA.frame.scale).toPrecision(2);
    panel.append(made("p", { name: "legend", text: `Each side is ${side}″; residuals from −6 σ (blue) to +6 σ (orange).` }));
  } else {
    const text = DATA.instruments.length ? "This page has no pictures of this source: it holds those of the sources that matter most." : "There are no images to show.";
    panel.append(made("p", { name: "about", text }));
  }
  if (details) panel.append(factsOf(details.facts), fluxTable(details.fluxes));
  else panel.append(factsOf([["S/N", String(SOURCES.snr[row] ?? "–")], ["state", STATES[SOURCES.state[row]]]]));
  const others = membersOf(row);
  if (others.length) {
    const text = made("p", { name: "legend", text: "Same blend: " });
    others.slice(0, 40).forEach((i) => text.append(sourceLink(i), " "));
    if (others.length > 40) text.append(`and ${others.length - 40} more`);
    panel.append(text);
  }
  view.chosen = row;
  view.go(SOURCES.x[row], SOURCES.y[row]);
  root.dataset.shown = SOURCES.id[row];
}
