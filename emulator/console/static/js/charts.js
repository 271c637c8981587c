// Plots of error and health over time, with a cursor to look back.

import uPlot from "/static/vendor/uPlot.esm.js";
import { fixed, make, press } from "./format.js";
import { colour, onTheme, pen } from "./theme.js";

const WINDOWS = [[60, "1 min"], [300, "5 min"], [900, "15 min"], [3600, "1 h"]];
const MAX_POINTS = 900;
const REDRAW_MS = 200;
const GAP_S = 20; // frames that are farther apart are not joined
const NICE = [1, 1.5, 2, 3, 5, 7, 10];

// Each plot: its series by column, and whether its range is symmetric about zero.
const PLOTS = [
  {
    title: "cross-boresight error, ″", symmetric: true, digits: 2,
    band: { sigma: "sigma_cross", times: 3 },
    series: [{ name: "x", column: "error_x", ink: "a" }, { name: "y", column: "error_y", ink: "b" }, { name: "3σ", column: "sigma_cross", times: 3, hidden: true }],
  },
  {
    title: "roll error, ″", symmetric: true, digits: 1,
    band: { sigma: "sigma_roll", times: 3 },
    series: [{ name: "roll", column: "error_roll", ink: "a" }, { name: "3σ", column: "sigma_roll", times: 3, hidden: true }],
  },
  {
    title: "rate, °/s, measured; true dashed", symmetric: true, digits: 4, least: 0.01,
    series: [
      { name: "x", column: "rate_x", ink: "a" }, { name: "y", column: "rate_y", ink: "b" }, { name: "z", column: "rate_z", ink: "c" },
      { name: "", column: "true_rate_x", ink: "a", dash: true }, { name: "", column: "true_rate_y", ink: "b", dash: true }, { name: "", column: "true_rate_z", ink: "c", dash: true },
    ],
  },
  {
    title: "stars", digits: 0, least: 10,
    series: [{ name: "detected", column: "detected", ink: "b" }, { name: "matched", column: "matched", ink: "a" }],
  },
  {
    title: "ms", digits: 1, least: 10,
    series: [
      { name: "render", column: "render_ms", ink: "c" }, { name: "detect", column: "detect_ms", ink: "b" },
      { name: "identify", column: "identify_ms", ink: "a" }, { name: "to publish", column: "latency_ms", ink: "dim" },
    ],
  },
];

export class Charts {
  constructor(store) {
    this.store = store;
    this.window = 60;
    this.host = document.getElementById("plots");
    this.modes = document.getElementById("modes");
    this.plots = [];
    this.due = false;
    this.last = 0;
    const choice = document.getElementById("window");
    for (const [seconds, text] of WINDOWS) {
      choice.append(make("button", { type: "button", text, "data-window": String(seconds), onclick: () => this.setWindow(seconds) }));
    }
    this.setWindow(60);
    for (const event of ["rows", "cursor", "hello", "status"]) store.on(event, () => this.schedule());
    onTheme(() => this.build());
    new ResizeObserver(() => this.build()).observe(this.host);
    this.listen(this.modes, () => [0, this.modes.clientWidth]);
  }

  setWindow(seconds) {
    this.window = seconds;
    for (const button of document.querySelectorAll("[data-window]")) press(button, Number(button.dataset.window) === seconds);
    this.schedule();
  }

  // Click or drag to look at the past.
  listen(element, span) {
    let held = false;
    const move = (event) => {
      const box = element.getBoundingClientRect();
      const [left, width] = span();
      this.store.scrub(this.from + ((event.clientX - box.left - left) / width) * (this.to - this.from));
    };
    element.addEventListener("pointerdown", (event) => {
      held = true;
      element.setPointerCapture(event.pointerId);
      move(event);
    });
    element.addEventListener("pointermove", (event) => held && move(event));
    element.addEventListener("pointerup", () => (held = false));
  }

  schedule() {
    if (this.due) return;
    this.due = true;
    const wait = Math.max(0, this.last + REDRAW_MS - performance.now());
    setTimeout(() => requestAnimationFrame(() => this.redraw()), wait);
  }

  // Redraw the plots after a change of size or colours.
  build() {
    for (const plot of this.plots) plot.u.destroy();
    this.host.replaceChildren();
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const width = this.host.clientWidth;
    const height = this.host.clientHeight / PLOTS.length;
    if (width < 50 || height < 30) return;
    this.plots = PLOTS.map((plan, number) => this.make(plan, width, height, rem, number === PLOTS.length - 1));
    this.schedule();
  }

  make(plan, width, height, rem, last) {
    const box = make("div", { class: "plot" });
    const legend = make("div", { class: "legend" }, make("span", { class: "dim", text: plan.title }));
    const outputs = plan.series.map((series) => {
      const output = make("output", { class: "num" });
      if (series.name) {
        const key = make("span", { class: "key" }, make("i", { class: series.hidden ? "band" : "" }), `${series.name} `, output);
        key.firstChild.style.background = series.hidden ? "" : colour(series.ink);
        legend.append(key);
      }
      return output;
    });
    box.append(legend);
    this.host.append(box);
    const axis = { stroke: colour("dim"), font: `${0.72 * rem}px system-ui`, grid: { stroke: colour("grid"), width: 1 }, ticks: { show: false } };
    const series = [{}];
    for (const item of plan.series) {
      series.push({ stroke: item.hidden ? "transparent" : colour(item.ink), width: (item.dash ? 1 : 1.5) * pen(), dash: item.dash ? [4 * pen(), 4 * pen()] : undefined, points: { show: false }, spanGaps: false });
    }
    const bands = [];
    if (plan.band) {
      series.push({ stroke: colour("band-edge"), width: 1, points: { show: false } }, { stroke: colour("band-edge"), width: 1, points: { show: false } });
      bands.push({ series: [series.length - 2, series.length - 1], fill: colour("band") });
    }
    const own = { plan, outputs, range: [0, 1], scale: 0, u: null };
    const legendHeight = 1.25 * rem;
    own.u = new uPlot({
      width,
      height: height - legendHeight,
      legend: { show: false },
      cursor: { show: false },
      padding: [0.5 * rem, 0.9 * rem, last ? 0 : 0.4 * rem, 0],
      scales: { x: { time: false, range: () => [this.from, this.to] }, y: { range: () => own.range } },
      axes: [
        { ...axis, show: true, size: last ? 1.5 * rem : 2, splits: () => Array.from({ length: 7 }, (_, part) => this.to - (this.window * (6 - part)) / 6), values: (_, times) => times.map((time) => (last ? before(time - this.to) : "")) },
        { ...axis, size: 3.4 * rem, space: 1.6 * rem, values: (_, values) => values.map((item) => String(Number(item.toPrecision(6))).replace("-", "−")) },
      ],
      series,
      bands,
      hooks: { draw: [(plot) => this.drawCursor(plot)] },
    }, [[0], ...series.slice(1).map(() => [null])], box);
    this.listen(own.u.over, () => [0, own.u.over.clientWidth]);
    return own;
  }

  drawCursor(plot) {
    if (this.store.cursor === null) return;
    const x = plot.valToPos(this.store.cursor, "x", true);
    const { ctx, bbox } = plot;
    if (x < bbox.left || x > bbox.left + bbox.width) return;
    ctx.save();
    ctx.strokeStyle = colour("text");
    ctx.lineWidth = 1;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.restore();
  }

  // While paused, the window is kept, unless the cursor leaves it.
  setSpan() {
    const { store } = this;
    if (store.cursor === null) this.to = store.imageless ? store.time : store.now;
    else {
      this.to = Math.min(this.to ?? store.now, store.now);
      if (store.cursor > this.to) this.to = store.cursor;
      if (store.cursor < this.to - this.window) this.to = store.cursor + this.window;
    }
    this.from = this.to - this.window;
  }

  redraw() {
    this.due = false;
    this.last = performance.now();
    const { rows } = this.store;
    if (!rows) return;
    if (rows.length) this.setSpan();
    else [this.from, this.to] = [-this.window, 0];
    const picked = pick(rows, this.from, this.to);
    const position = this.store.position;
    for (const plot of this.plots) this.fill(plot, rows, picked, position);
    this.drawModes(rows, position);
  }

  fill(plot, rows, picked, position) {
    const { plan, outputs } = plot;
    const data = [picked.map((group, number) => rows.at((group || picked[number - 1])[1], "run_s"))];
    let highest = plan.least || 0;
    for (const series of plan.series) {
      const column = rows.column(series.column);
      const values = picked.map((group) => extreme(column, group, series.times || 1));
      if (!series.hidden) for (const item of values) if (item !== null && Math.abs(item) > highest) highest = Math.abs(item);
      data.push(values);
    }
    if (plan.band) {
      const column = rows.column(plan.band.sigma);
      const upper = picked.map((group) => extreme(column, group, plan.band.times));
      let typical = 0;
      for (const item of upper) if (item !== null) typical = Math.max(typical, item);
      highest = Math.max(highest, Math.min(typical, 5 * highest));
      data.push(upper, upper.map((item) => (item === null ? null : -item)));
    }
    this.setScale(plot, highest || 1);
    plot.range = plan.symmetric ? [-plot.scale, plot.scale] : [0, plot.scale];
    plot.u.setData(data);
    plan.series.forEach((series, number) => {
      if (!series.name) return;
      const item = position < 0 ? NaN : rows.at(position, series.column) * (series.times || 1);
      outputs[number].textContent = fixed(item, plan.digits, plan.digits ? plan.digits + 4 : 4);
    });
  }

  // A round range that grows at once but shrinks only when it is far too large, to prevent flicker.
  setScale(plot, highest) {
    const wanted = nice(1.1 * highest);
    if (wanted > plot.scale || wanted < 0.4 * plot.scale) plot.scale = wanted;
  }

  // The modes as a band, hatched where the attitude was not valid.
  drawModes(rows, position) {
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
    const modes = rows.column("mode");
    const valid = rows.column("valid");
    const times = rows.column("run_s");
    const reach = (at) => (rows.isFrame(at) ? times[at] + GAP_S : Infinity);
    let begin = rows.find(this.from);
    const end = rows.length ? rows.find(this.to) : -1;
    context.font = `${Math.max(10, height * 0.62)}px system-ui, sans-serif`;
    context.textBaseline = "middle";
    while (begin <= end && rows.length) {
      let stop = begin;
      while (stop < end && modes[stop + 1] === modes[begin] && valid[stop + 1] === valid[begin] && times[stop + 1] < reach(stop)) stop += 1;
      const left = Math.max(0, place(times[begin]));
      const right = Math.max(place(Math.min(stop < end ? times[stop + 1] : this.to, reach(stop))), left + 2);
      const name = this.store.hello.modes[modes[begin]];
      context.fillStyle = colour(`mode-${name}`) || colour("mode-standby");
      context.fillRect(left, 0, right - left, height);
      if (!valid[begin]) hatch(context, left, right, height);
      if (right - left > context.measureText(name).width + 8) {
        context.fillStyle = colour("mode-text");
        context.fillText(name.replaceAll("_", " "), left + 4, height / 2 + 1);
      }
      begin = stop + 1;
    }
    if (this.store.cursor !== null && position >= 0) {
      context.fillStyle = colour("text");
      context.fillRect(place(this.store.cursor), 0, 1.5, height);
    }
  }
}

// Rows of the window in groups [first, last], about MAX_POINTS of them, and null for a gap.
function pick(rows, from, to) {
  if (!rows.length) return [];
  const first = rows.find(from);
  const last = rows.find(to);
  const size = Math.max(1, Math.ceil((last - first + 1) / MAX_POINTS));
  const groups = [];
  const times = rows.column("run_s");
  for (let begin = first - (first % size); begin <= last; begin += size) {
    const group = [Math.max(begin, rows.start), Math.min(begin + size - 1, last)];
    if (group[1] < group[0]) continue;
    if (groups.length && times[group[0]] - times[groups.at(-1)[1]] > GAP_S) groups.push(null);
    groups.push(group);
  }
  return groups;
}

// The value of a group that is farthest from zero; null in a gap and if a value is missing.
function extreme(column, group, times) {
  if (!group) return null;
  const [first, last] = group;
  let best = 0;
  for (let at = first; at <= last; at++) {
    const item = column[at];
    if (Number.isNaN(item)) return null;
    if (Math.abs(item) >= Math.abs(best)) best = item;
  }
  return best * times;
}

function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return NICE.find((step) => step * power >= value) * power;
}

function before(seconds) {
  if (Math.abs(seconds) < 0.5) return "0";
  const text = seconds > -100 ? `${Math.round(-seconds)} s` : `${Math.round(-seconds / 6) / 10} min`;
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
