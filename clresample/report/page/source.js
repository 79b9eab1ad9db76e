/* One source: its pictures in every channel, its measurements, its neighbours in the blend. */

const ROW_OF = new Map(SOURCES.id.map((id, i) => [id, i]));
const TITLES = { data: "Data", model: "Model", residual: "Residual", alone: "Alone" };

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

/* Pictures of one channel in a source's panel; its layers are data, model, residual, alone. */
function stampPicture(one) {
  return new Picture(one, one.size[0], DATA.instruments[one.instrument]?.sigma[one.channel] ?? 1);
}

const layersOf = (one) => (one.own ? [...LAYERS, "alone"] : LAYERS);

/* Limits of one channel's pictures: white is the brightest of the model. */
function stampLimits(one, picture, layer, then) {
  if (layer === "residual") return { low: -RESIDUAL_SIGMAS, high: RESIDUAL_SIGMAS, knee: 1 };
  const model = picture.counts("model", then), knee = KNEE_SIGMAS * picture.unit;
  const high = model && model.reduce((a, b) => (b > a ? b : a), 8 * knee);
  return model && { low: -knee, high, knee };
}

/* Draw one picture in a canvas of the panel. */
function drawStamp(canvas, one, layer, box, own, view) {
  const side = 120 * Math.min(window.devicePixelRatio || 1, 2);
  canvas.width = canvas.height = side;
  const c = canvas.getContext("2d"), [x0, y0, n] = box, k = side / n, [w, h] = one.size;
  const picture = stampPicture(one);
  let done = false;
  const paint = () => {
    if (done) return;
    const limits = stampLimits(one, picture, layer, paint);
    const look = { stretch: view.look.stretch, palette: view.look.palette, limits };
    const image = limits && painted([picture], layer, [1], look, w, h, paint);
    if (!image) return;
    done = true;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colour("--sky");
    c.fillRect(0, 0, side, side);
    c.imageSmoothingEnabled = false;
    c.setTransform(k, 0, 0, -k, (0.5 - x0) * k, side - (0.5 - y0) * k);
    c.transform(...one.place);
    c.drawImage(image, 0, 0);
    c.setTransform(1, 0, 0, 1, 0, 0);
    for (let i = 0; i < SOURCES.x.length; i += 1) {
      const u = (SOURCES.x[i] - x0 + 0.5) * k, v = side - (SOURCES.y[i] - y0 + 0.5) * k;
      if (u < 0 || v < 0 || u > side || v > side || (layer === "alone" && i !== own)) continue;
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
  paint();
}

function stampsOf(row, stamps, view) {
  const alone = stamps.rows.some((one) => one.own), layers = alone ? [...LAYERS, "alone"] : LAYERS;
  const grid = made("div", { name: alone ? "stamps four" : "stamps" });
  grid.append(made("span"), ...layers.map((layer) => made("span", { text: TITLES[layer] })));
  root.dataset.stamps = "0";
  for (const one of stamps.rows) {
    grid.append(made("b", { text: one.name }));
    for (const layer of layers) {
      const canvas = made("canvas", { role: "img", "aria-label": `${layer} in ${one.name}` });
      grid.append(canvas);
      if (layersOf(one).includes(layer)) drawStamp(canvas, one, layer, stamps.box, row, view);
    }
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

/* Buttons of the panel: to the neighbours in brightness, and what can be taken along. */
function stepsOf(row, details) {
  const steps = made("div", { name: "steps" });
  const button = (text, act, able = true) => {
    const one = made("button", { text, type: "button" });
    one.disabled = !able;
    one.addEventListener("click", act);
    steps.append(one);
  };
  for (const [text, to] of [["← Brighter", row - 1], ["Fainter →", row + 1]]) {
    button(text, () => { location.hash = `source-${SOURCES.id[to]}`; }, to in SOURCES.id);
  }
  button("Copy coordinates", () => copyText(coordinatesOf(SOURCES.x[row], SOURCES.y[row])));
  if (details?.stamps) button("FITS", () => saveSource(row, details.stamps));
  return steps;
}

/* Show a source in the panel. */
function showSource(row, view) {
  const panel = byId("source"), details = DATA.details[row];
  panel.replaceChildren(made("h3", { text: `Source ${SOURCES.id[row]}`, tabindex: "-1" }), stepsOf(row, details));
  if (details?.stamps) {
    panel.append(stampsOf(row, details.stamps, view));
    const side = (details.stamps.box[2] * DATA.frame.scale).toPrecision(2);
    const alone = details.stamps.rows.some((one) => one.own) ? " Alone: data minus the models of all other sources." : "";
    panel.append(made("p", { name: "legend", text: `Each side is ${side}″; residuals from −6 σ (blue) to +6 σ (orange).${alone}` }));
  } else {
    const text = DATA.instruments.length ? "This page has no pictures of this source: it holds those of the sources that matter most." : "There are no images to show.";
    panel.append(made("p", { name: "about", text }));
  }
  if (details) panel.append(factsOf(details.facts), fluxTable(details.fluxes));
  else panel.append(factsOf([["S/N", String(SOURCES.snr[row] ?? "–")], ["state", STATES[SOURCES.state[row]]]]));
  const others = (BLENDS.get(SOURCES.parent[row]) ?? []).filter((i) => i !== row);
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
