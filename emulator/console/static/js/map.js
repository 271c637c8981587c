// The whole sky in Hammer's equal-area projection: bright stars, the trail of the boresight, Sun, Moon and Earth.

import { toSky } from "./directions.js";
import { drawRegion } from "./features.js";
import { colour, onTheme, pen } from "./theme.js";

const REDRAW_MS = 500;
const RAD = Math.PI / 180;
const TRAIL_POINTS = 600;
const SIDE_PARTS = 48; // of a side of the field of view: near a pole its right ascension changes fast

export class SkyMap {
  constructor(store) {
    this.store = store;
    this.canvas = document.getElementById("allsky");
    this.base = null;
    store.on("hello", () => this.redraw());
    store.on("shown", () => this.schedule());
    store.on("cursor", () => this.schedule());
    onTheme(() => this.redraw());
    new ResizeObserver(() => this.redraw()).observe(this.canvas.parentElement);
  }

  // Draw at most so often: the trail of an hour changes little from frame to frame.
  schedule() {
    if (this.due) return;
    this.due = true;
    setTimeout(() => requestAnimationFrame(() => {
      this.due = false;
      this.draw();
    }), REDRAW_MS);
  }

  // Right ascension increases to the left, as seen in the sky; 12 h is at the centre.
  place(ra, dec) {
    const longitude = (((180 - ra + 540) % 360) - 180) * RAD;
    const latitude = dec * RAD;
    const root = Math.sqrt(1 + Math.cos(latitude) * Math.cos(longitude / 2));
    return [
      this.middle[0] + (this.radius * 2 * Math.cos(latitude) * Math.sin(longitude / 2)) / root,
      this.middle[1] - (this.radius * Math.sin(latitude)) / root,
    ];
  }

  redraw() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height || !this.store.hello) return;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.middle = [width / 2, height / 2];
    this.radius = Math.min((width - 16) / 4, (height - 14) / 2);
    const base = document.createElement("canvas");
    base.width = this.canvas.width;
    base.height = this.canvas.height;
    const context = base.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.beginPath();
    context.ellipse(...this.middle, 2 * this.radius, this.radius, 0, 0, 2 * Math.PI);
    context.fillStyle = colour("map");
    context.fill();
    context.strokeStyle = colour("line");
    context.stroke();
    context.globalAlpha = 0.6;
    for (let ra = 0.01; ra < 360; ra += 60) this.line(context, Array.from({ length: 37 }, (_, i) => [ra, 5 * i - 90]));
    for (const dec of [-60, -30, 0, 30, 60]) this.line(context, Array.from({ length: 73 }, (_, i) => [Math.min(5 * i, 359.99), dec]));
    context.globalAlpha = 1;
    context.fillStyle = colour("map-star");
    for (const [ra, dec, magnitude] of this.store.hello.map) {
      const size = Math.max(0.5, 2.1 - 0.4 * magnitude) * Math.max(0.8, this.radius / 130);
      context.beginPath();
      context.arc(...this.place(ra, dec), size, 0, 2 * Math.PI);
      context.fill();
    }
    context.fillStyle = colour("dim");
    context.font = `${Math.max(12, this.radius / 12)}px system-ui, sans-serif`;
    context.textAlign = "center";
    for (const hours of [0.01, 6, 12, 18]) context.fillText(`${Math.round(hours)}h`, ...this.place(15 * hours, -7));
    this.base = base;
    this.draw();
  }

  // A line, interrupted where it crosses the edge of the map: between two points on either side of 0 h.
  line(context, points) {
    context.beginPath();
    let last = null;
    for (const [ra, dec] of points) {
      const here = this.place(ra, dec);
      const crosses = last !== null && Math.abs(((180 - ra + 540) % 360) - ((180 - last + 540) % 360)) > 180;
      if (last !== null && !crosses) context.lineTo(...here);
      else context.moveTo(...here);
      last = ra;
    }
    context.stroke();
  }

  draw() {
    const { store } = this;
    if (!this.base) return;
    const ratio = window.devicePixelRatio || 1;
    const context = this.canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.drawImage(this.base, 0, 0);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const position = store.position;
    if (position < 0) return;
    const { rows } = store;
    const trail = [];
    const step = Math.max(1, Math.floor((position - rows.start) / TRAIL_POINTS));
    for (let i = position; i >= rows.start && trail.length < TRAIL_POINTS; i -= step) if (rows.isFrame(i)) trail.push([rows.at(i, "true_ra"), rows.at(i, "true_dec")]);
    if (!trail.length) return;
    context.lineWidth = 2 * pen();
    context.font = `${Math.max(12, this.radius / 11)}px system-ui, sans-serif`;
    context.strokeStyle = colour("b");
    this.line(context, trail);
    const head = store.image && store.image.head;
    for (const body of (head && head.bodies) || []) this.drawBody(context, body);
    if (head && head.true_q && store.hello.camera) this.drawField(context, head);
    if (head) drawRegion(context, head, "good", (points) => this.line(context, points));
    context.fillStyle = colour("b");
    context.beginPath();
    context.arc(...this.place(...trail[0]), 3 * pen(), 0, 2 * Math.PI);
    context.fill();
  }

  drawBody(context, body) {
    const ink = colour(`map-${["sun", "moon", "earth"].includes(body.name) ? body.name : "planet"}`);
    const [x, y] = this.place(body.ra_deg, body.dec_deg);
    context.fillStyle = context.strokeStyle = ink;
    if (body.radius_deg > 3) this.line(context, circle(body.ra_deg, body.dec_deg, body.radius_deg));
    context.beginPath();
    context.arc(x, y, (body.name === "sun" ? 5 : 3.5) * pen(), 0, 2 * Math.PI);
    context.fill();
    context.textAlign = "left";
    context.strokeStyle = colour("map");
    context.lineWidth = 4 * pen();
    context.strokeText(body.name, x + 7 * pen(), y - 3 * pen());
    context.fillText(body.name, x + 7 * pen(), y - 3 * pen());
  }

  // The outline of the field of view.
  drawField(context, head) {
    const { focal_px: focal, centre_px: centre } = this.store.hello.camera;
    if (!focal || !centre) return;
    const corners = [[0, 0], [head.width, 0], [head.width, head.height], [0, head.height], [0, 0]];
    const points = [];
    for (let side = 0; side < 4; side++) {
      for (let part = 0; part < SIDE_PARTS; part++) {
        const x = corners[side][0] + ((corners[side + 1][0] - corners[side][0]) * part) / SIDE_PARTS;
        const y = corners[side][1] + ((corners[side + 1][1] - corners[side][1]) * part) / SIDE_PARTS;
        points.push(toSky([(x - centre[0]) / focal[0], (y - centre[1]) / focal[1], 1], head.true_q));
      }
    }
    points.push(points[0]);
    context.strokeStyle = colour("text");
    context.lineWidth = 1.2 * pen();
    this.line(context, points);
  }
}

// A small circle around a direction.
function circle(ra, dec, radius) {
  const points = [];
  const [d, r] = [dec * RAD, radius * RAD];
  for (let i = 0; i <= 72; i++) {
    const angle = (i * 5 + 0.001) * RAD;
    const sine = Math.sin(d) * Math.cos(r) + Math.cos(d) * Math.sin(r) * Math.cos(angle);
    const change = Math.atan2(Math.sin(angle) * Math.sin(r) * Math.cos(d), Math.cos(r) - Math.sin(d) * sine);
    points.push([(ra + change / RAD + 720) % 360, Math.asin(Math.max(-1, Math.min(1, sine))) / RAD]);
  }
  return points;
}
