/* Files to save: PNG, FITS, regions for DS9; coordinates to copy. */

const RAD = Math.PI / 180, BLOCK = 2880, CARD = 80;

function offer(name, parts, type) {
  const url = URL.createObjectURL(new Blob(parts, { type }));
  const link = made("a", { href: url, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
  root.dataset.saved = name;
}

/* A name as part of a file's. */
const safe = (text) => text.replace(/[^\w.-]+/g, "_");

function savePng(view) {
  const one = DATA.instruments[view.instrument];
  view.draw();
  view.canvas.toBlob((blob) => offer(`${safe(one?.name ?? "field")}-${view.layer}.png`, [blob], "image/png"));
}

/* A header card of FITS. */
function card(key, value, comment = "") {
  const text = typeof value === "string" ? `'${value.replace(/[^ -~]/g, "?").replaceAll("'", "''").slice(0, 60).padEnd(8)}'`
    : typeof value === "boolean" ? (value ? "T" : "F").padStart(20)
      : (Number.isInteger(value) ? String(value) : fixed(value)).padStart(20);
  return `${key.padEnd(8)}= ${text}${comment ? ` / ${comment}` : ""}`.slice(0, CARD).padEnd(CARD);
}

function fixed(value) {
  const text = String(value).toUpperCase();
  return text.includes("E") && !text.includes(".") ? text.replace("E", ".0E") : text;
}

/* One HDU: planes (C x ny x nx) of float32 with a list of cards; the first is primary. */
function hdu(planes, nx, ny, cards, first) {
  const axes = planes.length === 1 ? [nx, ny] : [nx, ny, planes.length];
  const head = [
    first ? card("SIMPLE", true) : card("XTENSION", "IMAGE"), card("BITPIX", -32), card("NAXIS", axes.length),
    ...axes.map((n, k) => card(`NAXIS${k + 1}`, n)), ...(first ? [card("EXTEND", true)] : [card("PCOUNT", 0), card("GCOUNT", 1)]),
    ...cards, "END".padEnd(CARD),
  ].join("");
  const size = 4 * nx * ny * planes.length, data = new DataView(new ArrayBuffer(Math.ceil(size / BLOCK) * BLOCK));
  planes.forEach((plane, k) => plane.forEach((v, i) => data.setFloat32(4 * (k * nx * ny + i), v)));
  return [head.padEnd(Math.ceil(head.length / BLOCK) * BLOCK), data.buffer];
}

/* Cards of the tangent plane through the frame's middle, for an image whose pixel (column, row),
   counted from the outer corner of its first one, lies at (a u + c v + x, b u + d v + y). */
function wcsCards([a, b, c, d, x, y]) {
  const { sky, axes: m } = DATA.frame;
  if (!sky) return [];
  const det = a * d - b * c, [dx, dy] = [sky.x - x, sky.y - y];
  const [u, v] = [(d * dx - c * dy) / det, (a * dy - b * dx) / det];
  const step = (fx, fy) => [(m[1][0] * fy + m[1][1] * fx) / 3600, (m[0][0] * fy + m[0][1] * fx) / 3600];
  const [[e1, n1], [e2, n2]] = [step(a, b), step(c, d)];
  const [lon, lat] = sky.names[0] === "RA" ? ["RA---TAN", "DEC--TAN"] : ["GLON-TAN", "GLAT-TAN"];
  return [
    card("CTYPE1", lon), card("CTYPE2", lat), card("CUNIT1", "deg"), card("CUNIT2", "deg"),
    card("CRVAL1", sky.ra), card("CRVAL2", sky.dec), card("CRPIX1", u + 0.5), card("CRPIX2", v + 0.5),
    card("CD1_1", e1), card("CD1_2", e2), card("CD2_1", n1), card("CD2_2", n2),
  ];
}

/* Resolves once all values that a function of `then` needs are decoded. */
function decoded(values) {
  return new Promise((done) => {
    const attempt = () => { const found = values(attempt); if (found) { attempt.done ||= (done(found), true); } };
    attempt();
  });
}

/* The pixels in view of the shown instrument, all channels of the shown layer, one FITS file. */
async function saveField(view) {
  const one = DATA.instruments[view.instrument], level = view.levelFor(view.instrument);
  const [w, h] = view.size, [layer, box] = [view.layer, [Infinity, Infinity, -Infinity, -Infinity]], cells = [];
  for (const k of view.visible(level)) {
    const at = view.affine(level.places[k]), [n, m] = level.places[k], [x0, y0] = level.origins[k];
    for (let row = 0; row < m; row += 1) {
      for (let column = 0; column < n; column += 1) {
        const [u, v] = at(column + 0.5, row + 0.5);
        if (u < 0 || v < 0 || u >= w || v >= h) continue;
        cells.push([k, row * n + column, x0 + column, y0 + row]);
        box[0] = Math.min(box[0], x0 + column); box[1] = Math.min(box[1], y0 + row);
        box[2] = Math.max(box[2], x0 + column + 1); box[3] = Math.max(box[3], y0 + row + 1);
      }
    }
  }
  if (!cells.length) return;
  const tiles = await decoded((then) => {
    const found = new Map();
    for (const k of new Set(cells.map(([k]) => k))) {
      const planes = one.channels.map((_, c) => tilePicture(one, level, k, c).counts(layer, then));
      if (planes.some((plane) => !plane)) return null;
      found.set(k, planes);
    }
    return found;
  });
  const nx = box[2] - box[0], ny = box[3] - box[1];
  const planes = one.channels.map(() => new Float32Array(nx * ny).fill(NaN));
  for (const [k, i, x, y] of cells) tiles.get(k).forEach((plane, c) => { planes[c][(y - box[1]) * nx + x - box[0]] = plane[i]; });
  const [, , a, b, c, d, x, y] = level.places[0], [ox, oy] = level.origins[0], [du, dv] = [box[0] - ox, box[1] - oy];
  const cards = [
    ...wcsCards([a, b, c, d, x + a * du + c * dv, y + b * du + d * dv]), card("BUNIT", "ct", level.scale > 1 ? `mean of ${level.scale} x ${level.scale} pixels` : ""),
    card("LAYER", layer), card("INSTRUME", one.name), ...one.channels.map((name, i) => card(`BAND${i + 1}`, name)),
    card("X0", box[0], "first column, of pixels of this size"), card("Y0", box[1], "first row"),
    card("ROUNDMOD", DATA.codes.smooth / 2, "relative rounding of models"), card("ROUNDRES", DATA.codes.noisy / 2, "relative rounding of residuals"),
  ];
  offer(`${safe(one.name)}-${layer}.fits`, hdu(planes, nx, ny, cards, true), "application/fits");
}

/* A source's pictures: an HDU for each channel, planes data, model, residual, and alone if known. */
async function saveSource(row, stamps) {
  const parts = [];
  for (const one of stamps.rows) {
    const picture = stampPicture(one), layers = layersOf(one);
    const planes = await decoded((then) => {
      const found = layers.map((layer) => picture.counts(layer, then));
      return found.every(Boolean) ? found : null;
    });
    const cards = [
      ...wcsCards(one.place), card("BUNIT", "ct"), card("EXTNAME", one.name), card("SOURCE", SOURCES.id[row]),
      ...layers.map((layer, k) => card(`PLANE${k + 1}`, layer)), card("X0", one.origin[0], "first column in the mosaic"), card("Y0", one.origin[1], "first row"),
    ];
    parts.push(...hdu(planes, ...one.size, cards, !parts.length));
  }
  offer(`source-${SOURCES.id[row]}.fits`, parts, "application/fits");
}

/* Regions of the wanted sources: ellipses, or circles of 1 arcsec where no shape is known. */
function saveRegions(view) {
  const { sky, offset } = DATA.frame, lines = ["# Region file format: DS9 version 4.1", sky ? (sky.names[0] === "RA" ? "icrs" : "galactic") : "image"];
  SOURCES.id.forEach((id, i) => {
    if (!view.wanted[i]) return;
    const size = SOURCES.size[i], e1 = SOURCES.e1[i] ?? 0, e2 = SOURCES.e2[i] ?? 0, e = Math.min(Math.hypot(e1, e2), 1);
    const place = sky ? skyOf(i).map((v) => v.toFixed(7)).join(",") : `${(SOURCES.x[i] + offset[1] + 1).toFixed(3)},${(SOURCES.y[i] + offset[0] + 1).toFixed(3)}`;
    const length = (v) => (sky ? `${v.toFixed(3)}"` : (v / (DATA.frame.scale ?? 1)).toFixed(3));
    const turned = sky ? 90 : 90 + imageAngle();
    const shape = size > 0
      ? `ellipse(${place},${length(2 * size * Math.sqrt(1 + e))},${length(2 * size * Math.sqrt(1 - e))},${(Math.atan2(e2, e1) / 2 / RAD + turned).toFixed(2)})`
      : `circle(${place},${length(1)})`;
    const mark = { 1: " color=orange", 2: " color=red" }[SOURCES.state[i]] ?? "";
    lines.push(`${shape} # text={${id}}${mark}`);
  });
  offer("sources.reg", [lines.join("\n"), "\n"], "text/plain");
}

/* The angle [deg] by which north is turned from the frame's y towards -x. */
function imageAngle() {
  const m = DATA.frame.axes;
  return m ? Math.atan2(m[0][1], m[0][0]) / RAD : 0;
}

/* Right ascension and declination [deg] of a place by a tangent plane through the frame's middle. */
function skyAt(x, y) {
  const { sky, axes: m } = DATA.frame;
  if (!sky) return null;
  const [nx, ny] = [x - sky.x, y - sky.y];
  const north = (m[0][0] * ny + m[0][1] * nx) / 3600 * RAD, east = (m[1][0] * ny + m[1][1] * nx) / 3600 * RAD;
  const d0 = sky.dec * RAD, below = Math.cos(d0) - north * Math.sin(d0);
  const ra = sky.ra + Math.atan2(east, below) / RAD;
  return [(ra + 360) % 360, Math.atan2(Math.sin(d0) + north * Math.cos(d0), Math.hypot(east, below)) / RAD];
}

/* The place (x, y) of a position [deg], by the same plane; null on the other side of the sky. */
function placeOf(ra, dec) {
  const { sky, axes: m } = DATA.frame;
  const [d, d0, a] = [dec * RAD, sky.dec * RAD, (ra - sky.ra) * RAD];
  const deep = Math.sin(d0) * Math.sin(d) + Math.cos(d0) * Math.cos(d) * Math.cos(a);
  if (deep <= 0) return null;
  const east = Math.cos(d) * Math.sin(a) / deep / RAD * 3600;
  const north = (Math.cos(d0) * Math.sin(d) - Math.sin(d0) * Math.cos(d) * Math.cos(a)) / deep / RAD * 3600;
  const det = m[0][0] * m[1][1] - m[0][1] * m[1][0];
  return [sky.x + (m[0][0] * east - m[1][0] * north) / det, sky.y + (m[1][1] * north - m[0][1] * east) / det];
}

/* The catalogue's own position [deg] of a source. */
function skyOf(i) {
  const columns = DATA.columns.map((one, k) => [one.kind, k]).filter(([kind]) => kind === "sky");
  return columns.length === 2 ? columns.map(([, k]) => SOURCES.columns[k][i]) : skyAt(SOURCES.x[i], SOURCES.y[i]);
}

/* Coordinates of a place as text: degrees, or pixels of a flat field. */
function coordinatesOf(x, y) {
  const at = skyAt(x, y), o = DATA.frame.offset;
  return at ? at.map((v) => v.toFixed(6)).join(" ") : `${(x + o[1]).toFixed(2)} ${(y + o[0]).toFixed(2)}`;
}

async function copyText(text) {
  root.dataset.copied = text;
  byId("answer").textContent = `Copied: ${text}`;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = made("textarea", { name: "away", readonly: "" });  // where pages may not use the clipboard
    area.value = text;
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
}
