/* From counts to colours: stretches, limits, colour maps, three channels as one picture. */

const MAPS = {
  grey: [[0, 0, 0], [255, 255, 255]],
  inverted: [[255, 255, 255], [0, 0, 0]],
  viridis: [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]],
  inferno: [[0, 0, 4], [87, 16, 110], [188, 55, 84], [249, 142, 9], [252, 255, 164]],
  residual: [[88, 174, 255], [18, 20, 26], [255, 150, 64]],  // dark in the middle: no flash
};
const RESIDUAL_SIGMAS = 6, KNEE_SIGMAS = 2.5;
const tables = new Map();

/* (3 x 256) colours of a map. */
function tableOf(name) {
  if (!tables.has(name)) {
    const ends = MAPS[name], table = new Uint8ClampedArray(768);
    for (let i = 0; i < 256; i += 1) {
      const at = i / 255 * (ends.length - 1), k = Math.min(Math.floor(at), ends.length - 2);
      for (let c = 0; c < 3; c += 1) table[3 * i + c] = ends[k][c] + (at - k) * (ends[k + 1][c] - ends[k][c]);
    }
    tables.set(name, table);
  }
  return tables.get(name);
}

/* A function from values to 0 ... 1; knee: where asinh turns from linear to logarithmic. */
function stretchOf(kind, { low, high, knee }) {
  const span = Math.max(high - low, 1e-30), part = (v) => Math.min(Math.max((v - low) / span, 0), 1);
  if (kind === "linear") return part;
  if (kind === "log") return (v) => Math.log1p(1000 * part(v)) / Math.log1p(1000);
  const k = Math.max(span / knee, 1e-3), end = Math.asinh(k);
  return (v) => Math.asinh(k * part(v)) / end;
}

/* Limits by the noise: {low, high, knee} [counts], of residuals [noise of a shown pixel]. */
function noiseLimits(instrument, band, layer) {
  if (layer === "residual") return { low: -RESIDUAL_SIGMAS, high: RESIDUAL_SIGMAS, knee: 1 };
  const three = instrument.colour;
  if (band < 0) return { low: -three.knee, high: three.white, knee: three.knee };
  const knee = KNEE_SIGMAS * instrument.sigma[band];
  return { low: -knee, high: instrument.whites[band], knee };
}

/* Limits by the values of an image: the line through its sorted values, steeper by the contrast. */
function zscale(values, contrast = 0.25) {
  const n = values.length, sorted = Float64Array.from(values).sort();
  if (n < 5) return [sorted[0] ?? 0, sorted[n - 1] ?? 1];
  const middle = (n - 1) / 2, kept = new Uint8Array(n).fill(1);
  let slope = 0, level = sorted[Math.floor(middle)];
  for (let round = 0; round < 5; round += 1) {
    let count = 0, x = 0, y = 0, xx = 0, xy = 0;
    for (let i = 0; i < n; i += 1) {
      if (!kept[i]) continue;
      const u = i - middle;
      count += 1; x += u; y += sorted[i]; xx += u * u; xy += u * sorted[i];
    }
    slope = (count * xy - x * y) / Math.max(count * xx - x * x, 1e-30);
    level = (y - slope * x) / count;
    const left = (i) => sorted[i] - level - slope * (i - middle);
    let sum = 0;
    for (let i = 0; i < n; i += 1) if (kept[i]) sum += left(i) ** 2;
    const most = 2.5 * Math.sqrt(sum / count), good = [];
    for (let i = 0; i < n; i += 1) if (Math.abs(left(i)) <= most) good.push(i);
    if (good.length < n / 2 || good.length === count) break;
    kept.fill(0);
    for (const i of good) kept[i] = 1;
  }
  const median = sorted[Math.floor(middle)], steep = slope / contrast;
  return [Math.max(sorted[0], median - steep * middle), Math.min(sorted[n - 1], median + steep * middle)];
}

/* Values of pictures (one, or three of a colour picture) as one: mean residual [noise of a shown
   pixel], or light [counts]; null while they are not decoded. */
function lightOf(pictures, layer, balance, then) {
  const planes = pictures.map((one) => one.counts(layer, then));
  if (planes.some((plane) => !plane)) return null;
  const factor = layer === "residual"
    ? pictures.map((one) => 1 / one.unit / Math.sqrt(planes.length))
    : pictures.map((_, k) => balance[k] / planes.length);
  const light = planes[0].map((v) => v * factor[0]);
  for (let k = 1; k < planes.length; k += 1) planes[k].forEach((v, i) => { light[i] += v * factor[k]; });
  return { light, planes };
}

/* A canvas of columns x rows of a layer; null while it is not decoded. */
function painted(pictures, layer, balance, look, columns, rows, then) {
  const found = lightOf(pictures, layer, balance, then);
  if (!found) return null;
  const { light, planes } = found, canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [columns, rows];
  const context = canvas.getContext("2d"), image = context.createImageData(columns, rows), out = image.data;
  const level = stretchOf(layer === "residual" ? "linear" : look.stretch, look.limits), { knee, low } = look.limits;
  const table = tableOf(layer === "residual" ? "residual" : look.palette);
  const three = layer !== "residual" && pictures.length === 3;
  for (let i = 0; i < light.length; i += 1) {
    let rgb = DATA.empty;
    if (Number.isFinite(light[i])) {
      const part = level(light[i]);
      if (three) {
        // colours only where there is light: those of the noise are meaningless
        const bright = Math.max(light[i], 0), share = bright / (bright + knee), shift = Math.max(-low, 0);
        const factor = part / Math.max(light[i] + shift, knee / 4);
        const own = planes.map((plane, k) => (light[i] + (plane[i] * balance[k] - light[i]) * share + shift) * factor);
        const most = Math.max(1, ...own);
        rgb = [2, 1, 0].map((k) => 255 * Math.max(own[k], 0) / most);
      } else {
        const at = 3 * Math.round(255 * part);
        rgb = [table[at], table[at + 1], table[at + 2]];
      }
    }
    out.set([rgb[0], rgb[1], rgb[2], 255], 4 * i);
  }
  context.putImageData(image, 0, 0);
  return canvas;
}
