// How an algorithm of the thesis identified the image: features beside those of the nearest cell, the region of search, and
// the detections that the false-star filter removed.

import { fixed, make, setText } from "./format.js";
import { colour, pen } from "./theme.js";

const NAMES = ["n", "A", "r", "σ_A", "σ_r"];
const MEANINGS = ["number of stars", "mean brightness", "distance of the centroid", "deviation of the brightness", "deviation of the distances"];
const SIDE_PARTS = 12; // of a side of the region: near a pole its right ascension changes fast

export class Features {
  constructor(store) {
    this.store = store;
    this.bars = NAMES.map(() => ["observed", "cell"].map((kind) => make("i", { class: kind })));
    this.text = make("p", { class: "num" });
    this.box = make("div", { id: "features", role: "group", "aria-label": "features of the image and of the nearest cell", hidden: true },
      make("dl", {}, ...NAMES.flatMap((name, row) => [make("dt", { text: name, title: MEANINGS[row] }), make("dd", {}, ...this.bars[row])])),
      this.text);
    document.getElementById("map").append(this.box);
    store.on("shown", () => this.show());
  }

  show() {
    const { image } = this.store;
    const known = image && image.head.features;
    this.box.hidden = !known;
    if (!known) return;
    this.bars.forEach((pair, row) => {
      [known.observed[row], known.of_cell[row]].forEach((value, kind) => {
        pair[kind].style.width = `${Math.max(0, Math.min(100, value))}%`;
        pair[kind].title = `${kind ? "nearest cell" : "image"}: ${fixed(value, 1)} of 100`;
      });
    });
    const search = known.search === "rsi" ? `RSI, ${fixed(known.region_deg, 1)}°` : known.triggered ? "RSI, then LSI" : "LSI";
    const psi = known.error_psi === null ? "too few stars" : `ε_ψ ${fixed(known.error_psi, 2)}`;
    const cell = known.cell < 0 ? [] : [`cell ${known.cell + 1}`, `${known.weights} weights`];
    const moved = known.translation_deg || known.rotation_deg;
    const motion = moved ? [`moved ${fixed(known.translation_deg, 2)}°, turned ${fixed(known.rotation_deg, 2)}°`] : [];
    const facts = [search, psi, ...cell, `${known.removed.length} removed`, ...motion, ...(known.refined ? ["refined"] : [])];
    setText(this.text, facts.join(" · "));
  }
}

// Cross out the detections that the filter removed; `place` gives the place of a position on the screen.
export function drawRemoved(context, head, place) {
  context.strokeStyle = colour("on-sky-bad");
  context.lineWidth = 1.5 * pen();
  const arm = 7 * pen();
  for (const row of (head.features && head.features.removed) || []) {
    const [x, y] = place(head.detections[row][0], head.detections[row][1]);
    context.beginPath();
    context.moveTo(x - arm, y - arm);
    context.lineTo(x + arm, y + arm);
    context.stroke();
  }
}

// Draw the region of search in a colour; `line` draws a line of right ascensions and declinations.
export function drawRegion(context, head, ink, line) {
  const known = head.features;
  if (!known || !known.region_deg) return;
  const [ra, dec] = known.region_at_deg;
  const half = known.region_deg / 2;
  const [low, high] = [Math.max(dec - half, -90), Math.min(dec + half, 90)];
  const wide = Math.min(half / Math.max(Math.cos((dec * Math.PI) / 180), 1e-3), 180);
  const points = [];
  for (let i = -SIDE_PARTS; i <= SIDE_PARTS; i++) points.push([ra + (wide * i) / SIDE_PARTS, low]);
  for (let i = SIDE_PARTS; i >= -SIDE_PARTS; i--) points.push([ra + (wide * i) / SIDE_PARTS, high]);
  points.push(points[0]);
  context.strokeStyle = colour(ink);
  context.lineWidth = 2 * pen();
  line(points.map(([a, d]) => [(a + 360) % 360, d]));
}
