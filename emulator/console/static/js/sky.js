// The sensor image with matched, unmatched and missing stars.

import { toSensor } from "./directions.js";
import { drawRegion, drawRemoved } from "./features.js";
import { fixed, press, save, say, setText } from "./format.js";
import { colour, onTheme, pen } from "./theme.js";

const PAN_PX = 40;
const HOVER_PX = 14;
const MAX_ZOOM = 16;
const SPOKEN_MS = 5000;

export class Sky {
  constructor(store) {
    this.store = store;
    this.image = document.getElementById("image");
    this.overlay = document.getElementById("overlay");
    this.stage = this.image.parentElement;
    this.hover = document.getElementById("hover");
    this.notice = document.getElementById("no-frame");
    this.layers = { matched: true, unmatched: true, missing: true, bodies: true };
    this.zoom = 1;
    this.offset = [0, 0]; // image pixels at the top left
    this.bitmap = null;
    this.shown = null;
    this.pointer = null;
    this.decoding = false;
    this.stars = []; // what can be pointed at: place and text
    this.painted = 0; // images drawn since the page was opened
    store.on("shown", () => this.show());
    store.on("status", () => this.show());
    onTheme(() => this.draw());
    new ResizeObserver(() => this.resize()).observe(this.stage);
    this.listen();
  }

  listen() {
    for (const button of document.querySelectorAll("[data-layer]")) {
      button.addEventListener("click", () => this.toggle(button.dataset.layer));
    }
    const stretch = document.getElementById("stretch");
    const apply = () => (this.image.style.filter = `brightness(${stretch.value})`);
    stretch.addEventListener("input", apply);
    apply();
    document.getElementById("zoom-reset").addEventListener("click", () => this.reset());
    document.getElementById("save-image").addEventListener("click", () => this.png());
    this.stage.addEventListener("wheel", (event) => {
      if (this.zoom === 1 && event.deltaY > 0) return; // the page scrolls on
      event.preventDefault();
      this.zoomAt(event.offsetX, event.offsetY, Math.exp(-event.deltaY / 400));
    }, { passive: false });
    this.stage.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "touch" && this.zoom === 1) return; // a swipe scrolls the page
      this.drag = [event.clientX, event.clientY, ...this.offset];
      this.stage.setPointerCapture(event.pointerId);
    });
    this.stage.addEventListener("pointerup", () => (this.drag = null));
    this.stage.addEventListener("pointermove", (event) => {
      if (this.drag) {
        const scale = this.scale();
        this.offset = [this.drag[2] - (event.clientX - this.drag[0]) / scale, this.drag[3] - (event.clientY - this.drag[1]) / scale];
        this.draw();
      }
      const box = this.stage.getBoundingClientRect();
      this.pointer = [event.clientX - box.left, event.clientY - box.top];
      this.point();
    });
    this.stage.addEventListener("pointerleave", () => {
      this.pointer = null;
      this.hover.hidden = true;
    });
  }

  // Move the enlarged image.
  pan(right, down) {
    this.offset[0] += (PAN_PX * right) / this.scale();
    this.offset[1] += (PAN_PX * down) / this.scale();
    this.draw();
  }

  // Point at the next star to the right (1) or left (-1) of the one under the pointer, which noise from image to image hardly reorders.
  go(step) {
    if (!this.stars.length) return;
    const ordered = [...this.stars].sort(([a], [b]) => a - b);
    const at = ordered.indexOf(this.nearest());
    const star = ordered.at(at < 0 && step < 0 ? -1 : (at + step) % ordered.length);
    this.pointer = this.place(star[0], star[1]);
    this.point();
    say(star[2].replaceAll("\n", ", "));
  }

  // The image with its marks, as shown.
  png() {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [this.image.width, this.image.height];
    const context = canvas.getContext("2d");
    context.fillStyle = colour("sky");
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.filter = this.image.style.filter;
    context.drawImage(this.image, 0, 0);
    context.filter = "none";
    context.drawImage(this.overlay, 0, 0);
    canvas.toBlob((blob) => save("starhil-image.png", blob));
  }

  toggle(layer) {
    this.layers[layer] = !this.layers[layer];
    press(document.querySelector(`[data-layer="${layer}"]`), this.layers[layer]);
    this.draw();
  }

  reset() {
    this.zoom = 1;
    this.offset = [0, 0];
    this.draw();
  }

  zoomAt(x, y, factor) {
    const before = this.scale();
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), MAX_ZOOM);
    const after = this.scale();
    this.offset[0] += x / before - x / after;
    this.offset[1] += y / before - y / after;
    this.draw();
  }

  zoomCentre(factor) {
    this.zoomAt(this.stage.clientWidth / 2, this.stage.clientHeight / 2, factor);
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    for (const canvas of [this.image, this.overlay]) {
      canvas.width = Math.round(this.stage.clientWidth * ratio);
      canvas.height = Math.round(this.stage.clientHeight * ratio);
    }
    this.draw();
  }

  // Screen pixels per image pixel.
  scale() {
    const head = this.shown && this.shown.head;
    if (!head || !head.width) return 1;
    return Math.min(this.stage.clientWidth / head.width, this.stage.clientHeight / head.height) * this.zoom;
  }

  // Decode the image to be shown; images that arrive during decoding wait, and only the latest of them is used.
  async show() {
    if (this.decoding) return;
    const { image, hello, stepping } = this.store;
    if (!image) this.say(this.reason(hello, stepping));
    if (image === this.shown) return;
    this.decoding = true;
    const bitmap = image && await createImageBitmap(image.blob).catch(() => null);
    this.decoding = false;
    if (this.bitmap) this.bitmap.close();
    this.bitmap = bitmap;
    this.shown = image;
    this.painted += bitmap ? 1 : 0;
    if (image) this.say(bitmap ? "" : "this image cannot be decoded");
    this.stars = image ? this.describe(image.head) : [];
    this.speak();
    this.draw();
    this.point();
    if (this.store.image !== image) this.show();
  }

  // The image in words, for those who do not see it; not as it changes.
  speak() {
    const now = performance.now();
    if (now - (this.spoken || -Infinity) < SPOKEN_MS) return;
    this.spoken = now;
    const { head } = this.shown || {};
    const names = head ? head.hips.map((hip) => this.store.hello.star_names[hip]).filter(Boolean) : [];
    setText(document.getElementById("stage-text"), head ? `${(head.detections || []).length} stars detected, ${head.hips.filter(Boolean).length} matched${names.length ? `, among them ${names.slice(0, 5).join(", ")}` : ""}. n and p go from star to star, Shift with arrows moves the enlarged image.` : "no image");
  }

  // Why there is no image, and what to do.
  reason(hello, stepping) {
    if (hello && hello.clock === "stepped" && !stepping) return "no image: the clock is stopped, step it to take one";
    const { status } = this.store;
    if (!status || status.mode !== "standby") return "no image";
    const command = hello.telecommands.find((row) => row.name === "set_mode");
    return command ? "Standby: send set_mode lost_in_space for images" : "Standby: command a mode with images";
  }

  // Show why there is no image.
  say(text) {
    setText(this.notice, text);
    this.notice.hidden = !text;
  }

  limitOffset(head, scale) {
    for (const [axis, size, room] of [[0, head.width, this.stage.clientWidth], [1, head.height, this.stage.clientHeight]]) {
      const seen = room / scale;
      this.offset[axis] = seen >= size ? (size - seen) / 2 : Math.min(Math.max(this.offset[axis], 0), size - seen);
    }
  }

  // Convert image pixels, whose centres are integers, to screen coordinates.
  place(x, y) {
    const scale = this.scale();
    return [(x + 0.5 - this.offset[0]) * scale, (y + 0.5 - this.offset[1]) * scale];
  }

  draw() {
    const ratio = window.devicePixelRatio || 1;
    const base = this.image.getContext("2d");
    base.setTransform(1, 0, 0, 1, 0, 0);
    base.clearRect(0, 0, this.image.width, this.image.height);
    const marks = this.overlay.getContext("2d");
    marks.setTransform(1, 0, 0, 1, 0, 0);
    marks.clearRect(0, 0, this.overlay.width, this.overlay.height);
    if (!this.shown || !this.bitmap) return;
    const { head } = this.shown;
    const scale = this.scale();
    this.limitOffset(head, scale);
    base.imageSmoothingEnabled = scale < 3;
    base.imageSmoothingQuality = "high";
    base.setTransform(ratio, 0, 0, ratio, 0, 0);
    base.drawImage(this.bitmap, -this.offset[0] * scale, -this.offset[1] * scale, head.width * scale, head.height * scale);
    marks.setTransform(ratio, 0, 0, ratio, 0, 0);
    setText(document.getElementById("zoom"), `${this.zoom.toFixed(1)}×`);
    if (this.layers.bodies) this.drawBodies(marks, head);
    this.drawStars(marks, head);
    drawRemoved(marks, head, (x, y) => this.place(x, y));
    drawRegion(marks, head, "on-sky-rate", (points) => this.skyLine(marks, head, points));
    if (this.layers.bodies) this.drawRate(marks, head);
    this.point();
  }

  drawBodies(context, head) {
    context.lineWidth = 1.5 * pen();
    for (const polygon of head.covered || []) {
      if (!polygon.length) continue;
      context.beginPath();
      for (const corner of polygon) context.lineTo(...this.place(...corner));
      context.closePath();
      context.fillStyle = this.hatch(context, colour("on-sky-bad"));
      context.fill();
      context.strokeStyle = colour("on-sky-bad");
      context.stroke();
    }
    const ink = colour("on-sky-body");
    context.font = this.font();
    for (const body of head.bodies || []) {
      let label = null;
      context.strokeStyle = ink;
      context.beginPath();
      let drawing = false;
      for (const point of body.outline_px) {
        if (!point) {
          drawing = false;
          continue;
        }
        const [x, y] = this.place(...point);
        const inside = x > 0 && y > 0 && x < this.stage.clientWidth && y < this.stage.clientHeight;
        if (inside && (!label || y < label[1])) label = [x, y];
        if (drawing) context.lineTo(x, y);
        else context.moveTo(x, y);
        drawing = true;
      }
      context.stroke();
      if (label) this.label(context, body.name, Math.min(label[0] + 6, this.stage.clientWidth - 50), Math.max(label[1] - 6, 14), ink);
    }
    context.strokeStyle = colour("on-sky-bad");
    for (const [x, y] of head.false_stars || []) {
      const [px, py] = this.place(x, y);
      context.beginPath();
      const arm = 5 * pen();
      context.moveTo(px - arm, py - arm);
      context.lineTo(px + arm, py + arm);
      context.moveTo(px + arm, py - arm);
      context.lineTo(px - arm, py + arm);
      context.stroke();
    }
  }

  hatch(context, stroke) {
    const tile = document.createElement("canvas");
    tile.width = tile.height = 10;
    const pen = tile.getContext("2d");
    pen.strokeStyle = stroke;
    pen.globalAlpha = 0.45;
    pen.beginPath();
    pen.moveTo(0, 10);
    pen.lineTo(10, 0);
    pen.stroke();
    return context.createPattern(tile, "repeat");
  }

  font() {
    return `${Math.max(12, this.stage.clientWidth / 48)}px system-ui, sans-serif`;
  }

  drawStars(context, head) {
    const names = this.store.hello.star_names;
    const size = Math.max(5, this.stage.clientWidth / 110);
    context.font = this.font();
    context.lineWidth = 1.4 * pen();
    const labels = [];
    const inks = { matched: colour("on-sky-matched"), unmatched: colour("on-sky-unmatched") };
    const half = Math.max(2, size * 0.4);
    (head.detections || []).forEach(([x, y, magnitude], number) => {
      const used = Boolean(head.hips[number]);
      const hip = head.hips[number] || head.unused[number];
      const layer = hip ? "matched" : "unmatched";
      if (!this.layers[layer]) return;
      const name = names[hip];
      const [px, py] = this.place(x, y);
      if (name && (magnitude < 2.6 || this.zoom > 2)) labels.push([name, px, py, inks[layer]]);
      context.strokeStyle = inks[layer];
      context.globalAlpha = used ? 1 : 0.75;
      context.beginPath();
      if (used) context.arc(px, py, size, 0, 2 * Math.PI);
      else context.rect(px - half, py - half, 2 * half, 2 * half);
      context.stroke();
    });
    context.globalAlpha = 1;
    this.drawLabels(context, labels, size);
    if (!this.layers.missing || !head.catalogue) return;
    context.strokeStyle = colour("on-sky-missing");
    context.setLineDash([2, 3]);
    for (const star of missing(head)) {
      const [px, py] = this.place(star[1], star[2]);
      context.beginPath();
      context.arc(px, py, size * 1.15, 0, 2 * Math.PI);
      context.stroke();
    }
    context.setLineDash([]);
  }

  // Names beside the stars, brightest first; names without enough space are omitted.
  drawLabels(context, labels, size) {
    const height = parseFloat(context.font);
    const taken = [];
    for (const [text, x, y, ink] of labels) {
      const width = context.measureText(text).width;
      const places = [[x + size + 3, y + height / 3], [x - size - 3 - width, y + height / 3], [x - width / 2, y - size - 4], [x - width / 2, y + size + height]];
      for (const [left, base] of places) {
        const box = [left, base - height, left + width, base + 2];
        const inside = box[0] >= 0 && box[2] <= this.stage.clientWidth && box[1] >= 0 && box[3] <= this.stage.clientHeight;
        if (!inside || taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) continue;
        taken.push(box);
        this.label(context, text, left, base, ink);
        break;
      }
    }
  }

  label(context, text, x, y, ink) {
    context.lineWidth = 3 * pen();
    context.strokeStyle = "rgba(5, 8, 12, 0.8)";
    context.strokeText(text, x, y);
    context.fillStyle = ink;
    context.fillText(text, x, y);
    context.lineWidth = 1.4 * pen();
  }

  // A line through right ascensions and declinations in front of the camera, whose distortion is left out.
  skyLine(context, head, points) {
    const { focal_px: focal, centre_px: centre } = this.store.hello.camera;
    const seen = points.map((point) => toSensor(point, head.true_q));
    if (!focal || !centre || seen.some(([, , z]) => z < 0.1)) return;
    context.beginPath();
    for (const [x, y, z] of seen) context.lineTo(...this.place(centre[0] + (focal[0] * x) / z, centre[1] + (focal[1] * y) / z));
    context.stroke();
  }

  // Motion of the boresight: with the body rate ω it is ω × z = (ω_y, −ω_x).
  drawRate(context, head) {
    const { index } = this.store.rows;
    const [x, y, z] = ["true_rate_x", "true_rate_y", "true_rate_z"].map((name) => head.row[index[name]]);
    const speed = Math.hypot(x, y);
    const centre = this.place(head.width / 2, head.height / 2);
    const ink = colour("on-sky-rate");
    context.strokeStyle = context.fillStyle = ink;
    const size = pen();
    context.lineWidth = 2 * size;
    context.beginPath();
    context.moveTo(centre[0] - 7 * size, centre[1]);
    context.lineTo(centre[0] + 7 * size, centre[1]);
    context.moveTo(centre[0], centre[1] - 7 * size);
    context.lineTo(centre[0], centre[1] + 7 * size);
    context.stroke();
    if (speed > 1e-3) {
      const length = this.stage.clientWidth * 0.06 * (1 + Math.log10(1 + speed * 20));
      const [ux, uy] = [y / speed, -x / speed];
      const tip = [centre[0] + ux * length, centre[1] + uy * length];
      context.beginPath();
      context.moveTo(...centre);
      context.lineTo(...tip);
      context.lineTo(tip[0] - size * (8 * ux + 5 * uy), tip[1] - size * (8 * uy - 5 * ux));
      context.moveTo(...tip);
      context.lineTo(tip[0] - size * (8 * ux - 5 * uy), tip[1] - size * (8 * uy + 5 * ux));
      context.stroke();
    }
    if (speed > 1e-3 || Math.abs(z) > 1e-3) {
      this.label(context, `true ${fixed(Math.hypot(speed, z), 3)} °/s`, centre[0] + 12 * size, centre[1] + 20 * size, ink);
    }
  }

  // Everything that can be pointed at: place in the image, and what it is.
  describe(head) {
    const names = this.store.hello.star_names;
    const magnitudes = new Map((head.catalogue || []).map((star) => [star[0], star[3]]));
    const found = (head.detections || []).map(([x, y, magnitude, snr], number) => {
      const hip = head.hips[number] || head.unused[number];
      const measured = `measured ${fixed(magnitude, 2)} mag, SNR ${fixed(snr, 0)}\nx ${fixed(x, 2)}  y ${fixed(y, 2)}`;
      if (!hip) return [x, y, `not identified\n${measured}`];
      const use = head.hips[number] ? "" : "identified, left out of the fit\n";
      return [x, y, `${names[hip] ? names[hip] + "  " : ""}HIP ${hip}  V ${fixed(magnitudes.get(hip), 2)}\n${use}${measured}`];
    });
    for (const star of missing(head)) found.push([star[1], star[2], `expected but not seen: ${names[star[0]] || ""} HIP ${star[0]}  V ${fixed(star[3], 2)}`]);
    for (const [x, y] of head.false_stars || []) found.push([x, y, "false star"]);
    return found;
  }

  // The star under the pointer.
  nearest() {
    if (!this.pointer || !this.shown) return undefined;
    const distances = this.stars.map(([x, y]) => {
      const [px, py] = this.place(x, y);
      return Math.hypot(px - this.pointer[0], py - this.pointer[1]);
    });
    const least = Math.min(...distances);
    return least < HOVER_PX ? this.stars[distances.indexOf(least)] : undefined;
  }

  // Describe the star under the pointer.
  point() {
    const star = this.nearest();
    this.hover.hidden = !star;
    if (!star) return;
    [, , this.hover.textContent] = star;
    const left = Math.min(this.pointer[0] + 14, this.stage.clientWidth - this.hover.offsetWidth - 4);
    const top = Math.min(this.pointer[1] + 14, this.stage.clientHeight - this.hover.offsetHeight - 4);
    this.hover.style.transform = `translate(${left}px, ${top}px)`;
  }
}

// Catalogue stars that were not detected although they are as bright as most identified ones, or V 4 if there are none.
export function missing(head) {
  const [identified, found] = [new Set(head.hips), new Set([...head.hips, ...head.unused])];
  const matched = (head.catalogue || []).filter((star) => identified.has(star[0])).map((star) => star[3]);
  matched.sort((a, b) => a - b);
  const limit = matched.length >= 4 ? matched[Math.floor(0.5 * matched.length)] : 4;
  return (head.catalogue || []).filter((star) => star[3] <= limit && !found.has(star[0]));
}
