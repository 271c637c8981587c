// Plots over time of history and telemetry, with marks of events, and statistics of the span that is shown.

import uPlot from "/static/vendor/uPlot.esm.js";
import { fixed, make, press, save, setText, short } from "./format.js";
import { colour, onTheme, pen } from "./theme.js";

const WINDOWS = [[60, "1 min"], [300, "5 min"], [900, "15 min"], [3600, "1 h"]];
const MAX_POINTS = 900;
const REDRAW_MS = 500; // shortest time between two drawings; a minute moves by less than a hundredth meanwhile
const SPOKEN_MS = 5000;
const GAP_S = 20; // frames that are farther apart are not joined
const MAX_MARKS = 300;
const NICE = [1, 1.5, 2, 3, 5, 7, 10];
const INKS = ["a", "b", "c", "d", "text"];
const SYNC = "time";
const KEPT = "starhil-plots";

// Each plot: its series, by column of the history or by field of a telemetry row, and whether its range is symmetric about zero.
const PLOTS = [
  {
    title: "Error across, ″", symmetric: true, digits: 2,
    band: { sigma: "sigma_cross", times: 3 },
    series: [{ name: "x", column: "error_x", ink: "a" }, { name: "y", column: "error_y", ink: "b" }, { name: "3σ", column: "sigma_cross", times: 3, hidden: true }],
  },
  {
    title: "Error about, ″", symmetric: true, digits: 1,
    band: { sigma: "sigma_roll", times: 3 },
    series: [{ name: "roll", column: "error_roll", ink: "a" }, { name: "3σ", column: "sigma_roll", times: 3, hidden: true }],
  },
  {
    title: "Rate, °/s", symmetric: true, digits: 4, least: 0.01,
    series: [
      { name: "x", column: "rate_x", ink: "a" }, { name: "y", column: "rate_y", ink: "b" }, { name: "z", column: "rate_z", ink: "c" },
      { name: "true", column: "true_rate_x", ink: "a", dash: true, silent: true }, { name: "", column: "true_rate_y", ink: "b", dash: true }, { name: "", column: "true_rate_z", ink: "c", dash: true },
    ],
  },
  {
    title: "Stars", digits: 0, least: 10,
    series: [{ name: "detected", column: "detected", ink: "b" }, { name: "matched", column: "matched", ink: "a" }],
  },
  {
    title: "Latency, ms", digits: 1, least: 10,
    series: [
      { name: "render", column: "render_ms", ink: "c" }, { name: "detect", column: "detect_ms", ink: "b" },
      { name: "identify", column: "identify_ms", ink: "a" }, { name: "to publish", column: "latency_ms", ink: "dim" },
    ],
  },
];

export class Charts {
  constructor(store, link) {
    this.store = store;
    this.link = link;
    this.window = 60;
    this.zoomed = null; // [from, to] while a part of the time is enlarged
    this.own = []; // plots that the user has put together
    this.folded = new Set();
    this.hidden = new Set(["page"]); // kinds of events without marks
    this.host = document.getElementById("plots");
    this.modes = document.getElementById("modes");
    this.table = document.querySelector("#statistics table");
    this.plots = [];
    this.due = false;
    this.last = 0;
    this.spoken = 0;
    const choice = document.getElementById("window");
    for (const [seconds, text] of WINDOWS) {
      choice.append(make("button", { type: "button", text, "data-window": String(seconds), onclick: () => this.setWindow(seconds) }));
    }
    this.setWindow(60);
    for (const event of ["rows", "cursor", "connected", "status", "events", "telemetry"]) store.on(event, () => this.schedule());
    store.on("hello", () => this.recall());
    onTheme(() => this.build());
    new ResizeObserver(() => this.build()).observe(this.host);
    document.getElementById("add-plot").addEventListener("click", () => this.choose());
    document.getElementById("save-csv").addEventListener("click", () => save("starhil.csv", new Blob([this.csv()], { type: "text/csv" })));
    document.getElementById("statistics").addEventListener("toggle", () => this.schedule());
    this.modes.addEventListener("click", (event) => store.scrub(this.from + (event.offsetX / this.modes.clientWidth) * (this.to - this.from)));
  }

  setWindow(seconds) {
    this.window = seconds;
    this.zoomed = null;
    for (const button of document.querySelectorAll("[data-window]")) press(button, Number(button.dataset.window) === seconds);
    this.schedule();
  }

  nextWindow() {
    const at = WINDOWS.findIndex(([seconds]) => seconds === this.window);
    this.setWindow(WINDOWS[(at + 1) % WINDOWS.length][0]);
  }

  // Move in time, by a share of the span.
  move(share) {
    this.store.scrub((this.store.cursor ?? this.store.now) + share * (this.to - this.from));
  }

  schedule() {
    if (this.due) return;
    this.due = true;
    const period = Math.max(REDRAW_MS, this.window / 1.8);
    const wait = this.store.cursor === null ? Math.max(0, this.last + period - performance.now()) : 0;
    const draw = () => requestAnimationFrame(() => this.redraw());
    if (wait) setTimeout(draw, wait);
    else draw();
  }

  // --- plots that the user puts together ---

  get plans() {
    return [...PLOTS, ...this.own];
  }

  // Telemetry rows that are plotted, and thus read.
  get rows() {
    return [...new Set(this.own.flatMap((plan) => plan.series.map((each) => each.row)).filter(Boolean))];
  }

  recall() {
    try {
      const saved = JSON.parse(localStorage.getItem(`${KEPT}-${this.store.hello.unit.name}`)) || [];
      this.own = saved.map((names) => this.plan(names)).filter((plan) => plan.series.length);
    } catch {
      this.own = [];
    }
    this.changed();
  }

  changed() {
    const names = this.own.map((plan) => plan.series.map((each) => each.key));
    localStorage.setItem(`${KEPT}-${this.store.hello.unit.name}`, JSON.stringify(names));
    this.store.emit("plotted");
    this.build();
  }

  plan(keys) {
    const series = [];
    for (const key of keys) {
      const [row, name] = key.split(".");
      const known = name ? this.store.hello.telemetry.some((each) => each.name === row && each.fields.some((field) => field.name === name)) : this.store.hello.columns.includes(row);
      if (known) series.push({ key, name: key.replaceAll("_", " "), ink: INKS[series.length % INKS.length], dash: key.startsWith("true_"), ...(name ? { row, field: name } : { column: row }) });
    }
    return { title: "", digits: 5, signed: true, own: true, series };
  }

  // Ask which numbers to plot.
  choose() {
    const dialog = document.getElementById("chooser");
    const { columns, telemetry } = this.store.hello;
    const numeric = telemetry.flatMap((row) => row.fields.filter((field) => !["text", "bytes", "enum"].includes(field.kind)).map((field) => `${row.name}.${field.name}`));
    const filter = make("input", { type: "search", placeholder: "filter", "aria-label": "filter" });
    const labels = [...columns.slice(2), ...numeric].map((key) => make("label", { class: "check" }, make("input", { type: "checkbox", value: key }), key));
    const list = make("div", { class: "options", tabindex: "0", role: "group", "aria-label": "numbers" }, ...labels);
    filter.oninput = () => { for (const label of labels) label.hidden = !label.textContent.includes(filter.value.trim().toLowerCase()); };
    const form = make("form", { method: "dialog" }, filter, list, make("div", { class: "bar" }, make("button", { value: "plot", class: "primary", text: "plot" }), make("button", { value: "", text: "cancel" })));
    dialog.replaceChildren(dialog.firstElementChild, form);
    dialog.onclose = () => {
      const keys = [...form.querySelectorAll("input:checked")].map((box) => box.value);
      if (dialog.returnValue !== "plot" || !keys.length) return;
      this.own.push(this.plan(keys));
      this.changed();
    };
    dialog.returnValue = "";
    dialog.showModal();
  }

  // --- drawing ---

  // Make the plots again after a change of size, colours or plots.
  build() {
    for (const plot of this.plots) if (plot.u) plot.u.destroy();
    this.plots = [];
    this.host.replaceChildren();
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const width = this.host.clientWidth;
    if (width < 50) return;
    const { plans } = this;
    const open = plans.filter((plan) => !this.folded.has(plan)).length;
    const room = (this.host.clientHeight - 1.6 * rem * plans.length - 1.5 * rem) / Math.max(1, open);
    const height = Math.floor(Math.max(room, 5 * rem));
    this.plots = plans.map((plan, number) => this.make(plan, width, height, rem, number === plans.length - 1));
    this.schedule();
  }

  make(plan, width, height, rem, last) {
    const folded = this.folded.has(plan);
    const title = make("button", { type: "button", class: "fold", "aria-expanded": String(!folded), text: `${folded ? "▸" : "▾"} ${plan.title}`, onclick: () => { if (folded) this.folded.delete(plan); else this.folded.add(plan); this.build(); } });
    const legend = make("div", { class: "legend" }, title);
    const outputs = plan.series.map((series) => {
      const output = make("span", { class: "num" });
      if (series.name) {
        const key = make("span", { class: "key" }, make("i", { class: series.hidden ? "band" : series.dash ? "dash" : "" }), series.name, output);
        if (!series.hidden) key.firstChild.style.color = colour(series.silent ? "text" : series.ink);
        legend.append(key);
      }
      return output;
    });
    const own = { plan, outputs, range: [0, 1], scale: 0, u: null, box: null };
    const name = plan.title || plan.series.map((each) => each.name).join(", ");
    const corner = make("span", { class: "corner" }, make("button", { type: "button", class: "small", text: "⤓", title: "save as PNG", "aria-label": `save the plot ${name} as PNG`, onclick: () => this.png(own) }));
    legend.append(corner);
    if (plan.own) corner.append(make("button", { type: "button", class: "small", text: "×", "aria-label": `remove the plot ${name}`, onclick: () => { this.own = this.own.filter((each) => each !== plan); this.changed(); } }));
    const box = make("div", { class: "plot" }, legend);
    this.host.append(box);
    if (folded) return own;
    own.box = make("div", { role: "img", "aria-label": name });
    box.append(own.box);
    const axis = { stroke: colour("dim"), font: `${0.75 * rem}px system-ui`, grid: { stroke: colour("grid"), width: 1 }, ticks: { show: false } };
    const series = [{}];
    for (const item of plan.series) {
      series.push({ stroke: item.hidden ? "transparent" : colour(item.ink), width: (item.dash ? 1 : 1.5) * pen(), dash: item.dash ? [4 * pen(), 4 * pen()] : undefined, points: { show: false }, spanGaps: Boolean(item.row) });
    }
    const bands = [];
    if (plan.band) {
      series.push({ stroke: colour("band-edge"), width: 1, points: { show: false } }, { stroke: colour("band-edge"), width: 1, points: { show: false } });
      bands.push({ series: [series.length - 2, series.length - 1], fill: colour("band") });
    }
    own.u = new uPlot({
      width,
      height: height + (last ? 1.5 * rem : 0),
      legend: { show: false },
      cursor: { y: false, points: { show: false }, sync: { key: SYNC }, drag: { x: true, y: false, setScale: false } },
      padding: [0.4 * rem, 0.9 * rem, last ? 0 : 0.3 * rem, 0],
      scales: { x: { time: false, range: () => [this.from, this.to] }, y: { range: () => own.range } },
      axes: [
        { ...axis, show: true, size: last ? 1.5 * rem : 2, splits: () => Array.from({ length: 7 }, (_, part) => this.to - ((this.to - this.from) * (6 - part)) / 6), values: (_, times) => times.map((time) => (last ? before(time - this.drawn) : "")) },
        { ...axis, size: 3.6 * rem, space: 1.6 * rem, values: (_, values) => values.map((item) => String(Number(item.toPrecision(6))).replace("-", "−")) },
      ],
      series,
      bands,
      hooks: {
        draw: [(plot) => this.drawMarks(plot)],
        setCursor: [() => this.read(own)],
        setSelect: [(plot) => this.zoom(plot)],
      },
    }, [[0], ...series.slice(1).map(() => [null])], own.box);
    own.u.over.addEventListener("click", (event) => { if (!this.dragged) this.store.scrub(own.u.posToVal(event.offsetX, "x")); this.dragged = false; });
    own.u.over.addEventListener("dblclick", () => { this.zoomed = null; this.store.scrub(null); this.schedule(); });
    return own;
  }

  // Enlarge the time that was marked.
  zoom(plot) {
    const { left, width } = plot.select;
    if (width < 4) return;
    this.dragged = true;
    this.zoomed = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.schedule();
  }

  // Events, and the moment that is shown.
  drawMarks(plot) {
    const { ctx, bbox } = plot;
    const line = (time, ink, width, alpha) => {
      const x = plot.valToPos(time, "x", true);
      if (!(x >= bbox.left && x <= bbox.left + bbox.width)) return;
      ctx.strokeStyle = colour(ink);
      ctx.lineWidth = width;
      ctx.globalAlpha = alpha;
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
    };
    ctx.save();
    for (const event of this.marks) line(event.t, { good: "good", bad: "bad" }[event.level] || "dim", pen(), 0.55);
    if (this.store.cursor !== null) line(this.store.cursor, "text", pen(), 1);
    ctx.restore();
  }

  get marks() {
    return this.store.events.filter((event) => !this.hidden.has(event.kind) && event.t >= this.from && event.t <= this.to).slice(-MAX_MARKS);
  }

  // While paused, the window is kept, unless the cursor leaves it.
  setSpan() {
    const { store } = this;
    this.drawn = store.present; // what the labels of the time axis count from, also when a plot is drawn again by itself
    if (this.zoomed) {
      [this.from, this.to] = this.zoomed;
      return;
    }
    if (store.cursor === null) this.to = store.present;
    else {
      this.to = Math.min(this.to ?? store.now, Math.max(store.now, store.time));
      if (store.cursor > this.to) this.to = store.cursor;
      if (store.cursor < this.to - this.window) this.to = store.cursor + this.window;
    }
    this.from = this.to - this.window;
  }

  redraw() {
    this.due = false;
    this.last = performance.now();
    const { rows } = this.store;
    if (!rows || document.hidden) return;
    if (rows.length) this.setSpan();
    else [this.from, this.to, this.drawn] = [-this.window, 0, 0];
    const picked = pick(rows, this.from, this.to);
    for (const plot of this.plots) this.fill(plot, rows, picked);
    this.drawModes(rows);
    if (document.getElementById("statistics").open) this.showStatistics();
    if (this.last - this.spoken > SPOKEN_MS) this.speak();
  }

  fill(plot, rows, picked) {
    const { plan } = plot;
    if (!plot.u) {
      this.read(plot);
      return;
    }
    const times = picked.map((group, number) => rows.at((group || picked[number - 1])[1], "run_s"));
    let highest = plan.least || 0;
    let data = [times];
    const tables = [];
    const note = (values) => { for (const item of values) if (item !== null && Math.abs(item) > highest) highest = Math.abs(item); };
    for (const series of plan.series) {
      if (series.row) {
        const samples = (this.store.samples.get(series.row) || []).filter(([time]) => time >= this.from && time <= this.to);
        const values = samples.map(([, item]) => (item[series.field] === undefined || item[series.field] === null ? null : Number(item[series.field])));
        note(values);
        tables.push([samples.map(([time]) => time), values]);
      } else {
        const values = picked.map((group) => extreme(rows, series.column, group, series.times || 1));
        if (!series.hidden) note(values);
        if (plan.own) tables.push([times, values]);
        else data.push(values);
      }
    }
    if (plan.own) data = uPlot.join(tables.map(([at, values]) => increasing(at, values)));
    if (plan.band) {
      const upper = picked.map((group) => extreme(rows, plan.band.sigma, group, plan.band.times));
      let typical = 0;
      for (const item of upper) if (item !== null) typical = Math.max(typical, item);
      highest = Math.max(highest, Math.min(typical, 5 * highest));
      data.push(upper, upper.map((item) => (item === null ? null : -item)));
    }
    this.setScale(plot, highest || 1);
    const below = plan.own && data.slice(1).some((values) => values.some((item) => item < 0));
    plot.range = plan.symmetric || below ? [-plot.scale, plot.scale] : [0, plot.scale];
    plot.u.setData(data);
    this.read(plot);
  }

  // Values under the pointer, or else of the moment that is shown.
  read({ plan, outputs, u }) {
    const { rows, position } = this.store;
    const under = u && u.cursor.idx !== null && u.cursor.idx !== undefined && u.cursor.left >= 0 ? u.cursor.idx : null;
    plan.series.forEach((series, number) => {
      if (!series.name || series.silent) return;
      let item = NaN;
      if (under !== null) item = u.data[number + 1][under] ?? NaN;
      else if (series.row) item = Number((this.store.samples.get(series.row) || []).at(-1)?.[1][series.field] ?? NaN);
      else if (position >= 0) item = rows.at(position, series.column) * (series.times || 1);
      setText(outputs[number], fixed(item, plan.digits, plan.digits ? plan.digits + 4 : 4));
    });
  }

  // The plots in words, for those who do not see them; not as they change.
  speak() {
    this.spoken = this.last;
    for (const { plan, outputs, box } of this.plots) {
      if (!box) continue;
      const now = plan.series.map((series, number) => (series.name && !series.silent ? `${series.name} ${outputs[number].textContent.trim()}` : "")).filter(Boolean);
      box.setAttribute("aria-label", `${plan.title}: ${now.join(", ")}; ${Math.round(this.to - this.from)} s are shown`);
    }
  }

  // A round range that grows at once but shrinks only when it is far too large, to prevent flicker.
  setScale(plot, highest) {
    const wanted = nice(1.1 * highest);
    if (wanted > plot.scale || wanted < 0.4 * plot.scale) plot.scale = wanted;
  }

  // The modes as a band, hatched where the attitude was not valid.
  drawModes(rows) {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.modes;
    if (this.modes.width !== Math.round(width * ratio) || this.modes.height !== Math.round(height * ratio)) {
      this.modes.width = Math.round(width * ratio);
      this.modes.height = Math.round(height * ratio);
    }
    const context = this.modes.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const place = (time) => ((time - this.from) / (this.to - this.from)) * width;
    const mode = (at) => rows.at(at, "mode");
    const time = (at) => rows.at(at, "run_s");
    const reach = (at) => (rows.isFrame(at) ? time(at) + GAP_S : Infinity);
    let begin = rows.find(this.from);
    const end = rows.length ? rows.find(this.to) : -1;
    context.font = `${Math.max(12, height * 0.62)}px system-ui, sans-serif`;
    context.textBaseline = "middle";
    while (begin <= end && rows.length) {
      let stop = begin;
      while (stop < end && mode(stop + 1) === mode(begin) && rows.at(stop + 1, "valid") === rows.at(begin, "valid") && time(stop + 1) < reach(stop)) stop += 1;
      const name = this.store.hello.modes[mode(begin)];
      if (name) {
        const left = Math.max(0, place(time(begin)));
        const right = Math.max(place(Math.min(stop < end ? time(stop + 1) : this.to, reach(stop))), left + 2);
        context.fillStyle = colour(`mode-${name}`) || colour("mode-standby");
        context.fillRect(left, 0, right - left, height);
        if (!rows.at(begin, "valid")) hatch(context, left, right, height);
        if (right - left > context.measureText(name).width + 8) {
          context.fillStyle = colour("mode-text");
          context.fillText(name.replaceAll("_", " "), left + 4, height / 2 + 1);
        }
      }
      begin = stop + 1;
    }
    context.fillStyle = colour("text");
    if (this.store.cursor !== null) context.fillRect(place(this.store.cursor), 0, 1.5, height);
  }

  // --- numbers to take home ---

  // The rows of the span, and the telemetry that is plotted, as CSV.
  csv() {
    const { rows, hello, samples, reasons } = this.store;
    const lines = [["series", ...hello.columns].join()];
    for (let at = rows.find(this.from); at < rows.end && rows.at(at, "run_s") <= this.to; at++) {
      const cells = hello.columns.map((name) => {
        const item = rows.at(at, name);
        if (Number.isNaN(item)) return "";
        return name === "mode" ? hello.modes[item] : name === "reason" ? reasons[item] : String(item);
      });
      if (rows.at(at, "run_s") >= this.from) lines.push(["history", ...cells].join());
    }
    for (const row of this.rows) {
      const found = (samples.get(row) || []).filter(([time]) => time >= this.from && time <= this.to);
      if (found.length) lines.push([row, "run_s", ...Object.keys(found[0][1])].join());
      for (const [time, values] of found) lines.push([row, time, ...Object.values(values)].join());
    }
    return `${lines.join("\n")}\n`;
  }

  // A plot with its legend.
  png(plot) {
    if (!plot.u) return;
    const source = plot.u.ctx.canvas;
    const canvas = make("canvas", { width: source.width, height: source.height + 40 * pen() });
    const context = canvas.getContext("2d");
    context.fillStyle = colour("panel");
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.font = `${18 * pen()}px system-ui, sans-serif`;
    let left = 10;
    const write = (text, ink) => {
      context.fillStyle = colour(ink);
      context.fillText(text, left, 26 * pen());
      left += context.measureText(text).width + 16 * pen();
    };
    write(`${this.store.hello.unit.name} ${plot.plan.title}`, "text");
    plot.plan.series.forEach((series, number) => series.name && write(`${series.name} ${plot.outputs[number].textContent.trim()}`, series.hidden ? "dim" : series.ink));
    context.drawImage(source, 0, 40 * pen());
    canvas.toBlob((blob) => save("starhil-plot.png", blob));
  }

  // Errors against what the device states, validity, lost frames and replies, of the span.
  showStatistics() {
    const { rows } = this.store;
    const columns = ["error_x", "error_y", "error_roll", "sigma_cross", "sigma_roll"];
    const sums = Object.fromEntries(columns.map((name) => [name, 0]));
    let [frames, valid, lost, within, last] = [0, 0, 0, [0, 0], NaN];
    for (let at = rows.find(this.from); at < rows.end && rows.at(at, "run_s") <= this.to; at++) {
      if (!rows.isFrame(at) || rows.at(at, "run_s") < this.from) continue;
      const frame = rows.at(at, "frame");
      if (frame > last + 1) lost += frame - last - 1;
      last = frame;
      frames += 1;
      if (rows.at(at, "valid") !== 1) continue;
      valid += 1;
      for (const name of columns) sums[name] += rows.at(at, name) ** 2;
      within[0] += Math.abs(rows.at(at, "error_x")) <= 3 * rows.at(at, "sigma_cross");
      within[1] += Math.abs(rows.at(at, "error_roll")) <= 3 * rows.at(at, "sigma_roll");
    }
    const rms = (name) => Math.sqrt(sums[name] / valid);
    const both = Math.sqrt((sums.error_x + sums.error_y) / 2 / valid);
    const share = (part, all) => (all ? `${fixed((100 * part) / all, 1)} %` : "–");
    const replies = this.link.replies.filter(([time]) => time >= this.from && time <= this.to);
    const taken = replies.map(([, ms]) => ms).filter((ms) => ms !== null).sort((a, b) => a - b);
    const quantile = (part) => (taken.length ? `${fixed(taken[Math.min(taken.length - 1, Math.floor(part * taken.length))], 1)} ms` : "–");
    const lines = [
      ["", "measured 1σ", "measured 3σ", "stated 1σ", "stated 3σ", "within stated 3σ"],
      ["error across, each axis, ″", fixed(both, 2), fixed(3 * both, 2), fixed(rms("sigma_cross"), 2), fixed(3 * rms("sigma_cross"), 2), share(within[0], valid)],
      ["error about, ″", fixed(rms("error_roll"), 2), fixed(3 * rms("error_roll"), 2), fixed(rms("sigma_roll"), 2), fixed(3 * rms("sigma_roll"), 2), share(within[1], valid)],
      ["frames", String(frames), `valid ${share(valid, frames)}`, `lost ${lost}`, "", ""],
      ["replies to this console", `p50 ${quantile(0.5)}`, `p99 ${quantile(0.99)}`, `lost ${replies.length - taken.length}`, `of ${replies.length}`, ""],
    ];
    if (this.table.rows.length !== lines.length) {
      this.table.replaceChildren(...lines.map((cells, line) => make("tr", {}, ...cells.map((_, cell) => make(line && cell ? "td" : "th", { class: cell ? "num" : "", scope: line ? (cell ? null : "row") : "col" })))));
    }
    lines.forEach((cells, line) => cells.forEach((text, cell) => setText(this.table.rows[line].cells[cell], text)));
  }
}

// Rows of the window in groups [first, last], about MAX_POINTS of them, and null for a gap.
function pick(rows, from, to) {
  if (!rows.length) return [];
  const first = rows.find(from);
  const last = rows.find(to);
  const size = Math.max(1, Math.ceil((last - first + 1) / MAX_POINTS));
  const groups = [];
  for (let begin = first - (first % size); begin <= last; begin += size) {
    const group = [Math.max(begin, rows.start), Math.min(begin + size - 1, last)];
    if (group[1] < group[0]) continue;
    if (groups.length && groups.at(-1) && rows.at(group[0], "run_s") - rows.at(groups.at(-1)[1], "run_s") > GAP_S) groups.push(null);
    groups.push(group);
  }
  return groups;
}

// The value of a group that is farthest from zero; null in a gap and if a value is missing.
function extreme(rows, name, group, times) {
  if (!group) return null;
  const column = rows.data[rows.index[name]];
  let best = 0;
  for (let at = group[0]; at <= group[1]; at++) {
    const item = column[at % rows.kept];
    if (Number.isNaN(item)) return null;
    if (Math.abs(item) >= Math.abs(best)) best = item;
  }
  return best * times;
}

// Points at increasing times, which joining needs.
function increasing(times, values) {
  const kept = times.map((_, at) => at).filter((at) => at === 0 || times[at] > times[at - 1]);
  return [kept.map((at) => times[at]), kept.map((at) => values[at])];
}

function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return NICE.find((step) => step * power >= value * (1 - 1e-9)) * power;
}

function before(seconds) {
  if (Math.abs(seconds) < 0.5) return "0";
  const text = seconds > -100 ? `${short(Math.round(-seconds))} s` : `${Math.round(-seconds / 6) / 10} min`;
  return `−${text}`;
}

function hatch(context, left, right, height) {
  context.save();
  context.beginPath();
  context.rect(left, 0, right - left, height);
  context.clip();
  context.strokeStyle = colour("mode-hatch");
  context.lineWidth = 2;
  context.beginPath();
  for (let x = left - height; x < right; x += 8) {
    context.moveTo(x, height);
    context.lineTo(x + height, 0);
  }
  context.stroke();
  context.restore();
}
