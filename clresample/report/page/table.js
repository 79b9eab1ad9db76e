/* Tables: sorted by their heads; that of the sources is filtered, and made from all of them. */

const MAX_ROWS = 500;  // of the table of sources at once: the page stays quick

/* A number as Python's format writes it, for the forms that the page has. */
function formatted(value, form) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const digits = Number(form.slice(1, -1));
  let text = value.toFixed(Math.min(digits, 20));
  if (form.endsWith("g")) {
    text = value.toPrecision(digits);
    const power = value === 0 ? 0 : Number(value.toExponential(digits - 1).split("e")[1]);
    if (power < -4 || power >= digits) {
      const [head, tail] = value.toExponential(digits - 1).split("e");
      text = `${trimmed(head)}e${tail[0]}${tail.slice(1).padStart(2, "0")}`;
    } else {
      text = trimmed(Number(text).toFixed(Math.max(0, digits - 1 - power)));
    }
  }
  return text.replaceAll("-", "−");
}

const trimmed = (text) => (text.includes(".") ? text.replace(/\.?0+$/, "") : text);

function flagNames(sum) {
  const names = DATA.flags.filter(([, value]) => sum & value).map(([name]) => name);
  const rest = sum & ~DATA.flags.reduce((all, [, value]) => all | value, 0);
  return [...names, ...(rest ? [String(rest)] : [])].join(", ") || "none";
}

/* The sources that pass the filters: an array of booleans. */
function wantedSources() {
  const value = (id) => byId(id)?.value ?? "";
  const number = (id) => (value(id) === "" ? null : Number(value(id)));
  const flags = value("filter-flags"), status = value("filter-status");
  const [snr, low, high] = ["filter-snr", "filter-low", "filter-high"].map(number);
  const mags = SOURCES.columns[Number(value("filter-band"))];
  return SOURCES.id.map((_, i) => (flags === "" || (flags === "0" ? SOURCES.flags[i] === 0 : flags === "any" ? SOURCES.flags[i] !== 0 : (SOURCES.flags[i] & Number(flags)) !== 0))
    && (status === "" || SOURCES.status[i] === Number(status))
    && (snr === null || (SOURCES.snr[i] ?? -Infinity) >= snr)
    && (low === null || (mags[i] !== null && mags[i] >= low))
    && (high === null || (mags[i] !== null && mags[i] <= high)));
}

function option(text, value) {
  return made("option", { text, value: String(value) });
}

/* Columns of the table with magnitudes: [title, place in SOURCES.columns]. */
function magnitudeColumns() {
  return DATA.columns.map((one, k) => [one.channel, k, one.kind]).filter(([, , kind]) => kind === "magnitude");
}

class SourceTable {
  constructor(view, changed) {
    this.view = view;
    this.changed = changed;
    this.table = document.querySelector("#sources table");
    this.sort = null;  // [column, 1 up or -1 down]
    if (!this.table) return;
    this.fill();
    const form = byId("filters");
    form.addEventListener("input", () => this.filter());
    form.addEventListener("reset", () => setTimeout(() => this.filter()));
    form.addEventListener("submit", (event) => event.preventDefault());
    [...this.table.tHead.rows[0].cells].forEach((head, i, heads) => sortedBy(head, heads, (way) => {
      this.sort = [i, way];
      this.draw();
    }));
    this.filter();
  }

  fill() {
    byId("filter-flags").append(option("all", ""), option("none", 0), option("any", "any"),
      ...DATA.flags.filter(([, value]) => SOURCES.flags.some((sum) => sum & value)).map(([name, value]) => option(name, value)));
    byId("filter-status").append(option("all", ""), ...DATA.statuses.map((text, k) => option(text, k)));
    byId("filter-band").append(...magnitudeColumns().map(([title, k]) => option(title, k)));
  }

  filter() {
    this.view.wanted = wantedSources();
    this.view.later();
    this.draw();
    this.changed();
  }

  key(i, column) {
    const n = DATA.columns.length;
    if (column === 0) return SOURCES.id[i];
    if (column <= n) return SOURCES.columns[column - 1][i];
    return column === n + 1 ? flagNames(SOURCES.flags[i]) : DATA.statuses[SOURCES.status[i]] ?? "";
  }

  draw() {
    const rows = SOURCES.id.map((_, i) => i).filter((i) => this.view.wanted[i]);
    if (this.sort) {
      const [column, way] = this.sort, id = column === 0;
      rows.sort((a, b) => {
        const [p, q] = [this.key(a, column), this.key(b, column)];
        if (p === null || q === null) return (p === null) - (q === null);
        if (id) return way * (BigInt(p) < BigInt(q) ? -1 : 1);
        return way * (typeof p === "string" ? p.localeCompare(q) : p - q);
      });
    }
    const shown = rows.slice(0, MAX_ROWS);
    this.table.tBodies[0].replaceChildren(...shown.map((i) => this.row(i)));
    const order = this.sort ? "" : ", the highest signal to noise first";
    this.table.caption.textContent = `${shown.length} of ${SOURCES.id.length} sources${order}`;
    byId("matches").textContent = `${rows.length} of ${SOURCES.id.length} sources`;
  }

  row(i) {
    const cells = DATA.columns.map((one, k) => made("td", { text: formatted(SOURCES.columns[k][i], one.form), name: "n" }));
    const [flags, status] = [flagNames(SOURCES.flags[i]), DATA.statuses[SOURCES.status[i]] ?? ""];
    return made("tr", {}, made("td", { name: "n" }, sourceLink(i)), ...cells, made("td", { text: flags }), made("td", { text: status }));
  }
}

/* Make a head a button that sorts: down at first, then up. */
function sortedBy(head, heads, sort) {
  const button = made("button", { type: "button" }, ...head.childNodes);
  head.append(button);
  button.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") === "descending" ? 1 : -1;
    [...heads].forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up > 0 ? "ascending" : "descending");
    sort(up);
  });
}

function startTables() {
  for (const table of document.querySelectorAll("table[data-sort]")) {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    const key = (row, i) => {
      const text = row.cells[i].textContent.replace("−", "-"), number = Number.parseFloat(text);
      return Number.isNaN(number) ? [1, 0, text] : [0, number, text];
    };
    heads.forEach((head, i) => sortedBy(head, heads, (up) => {
      const rows = [...body.rows].map((row) => [key(row, i), row]);
      rows.sort(([a], [b]) => a[0] - b[0] || up * (a[1] - b[1]) || up * a[2].localeCompare(b[2]));
      body.append(...rows.map(([, row]) => row));
    }));
  }
  for (const cell of document.querySelectorAll("[data-source]")) {
    const row = ROW_OF.get(cell.textContent);
    if (row !== undefined) cell.replaceChildren(sourceLink(row));
  }
}
