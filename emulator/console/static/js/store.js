// Data of the page: the description of the run, and numbers and images of the last hour.

const RECENT_S = 60; // every image of the last minute is kept …
const SPARSE_S = 5; // … and one in five seconds of the last hour
const KEPT_S = 3600;
const OVERDUE_S = 10; // age at which the newest frame is of the past

// Rows of numbers by column, in arrays with the latest rows at the end.
class Rows {
  constructor(columns, kept) {
    this.kept = kept;
    this.index = Object.fromEntries(columns.map((name, number) => [name, number]));
    this.width = columns.length;
    this.data = columns.map(() => new Float64Array(2 * kept));
    this.start = 0;
    this.end = 0;
  }

  push(row) {
    if (this.end === 2 * this.kept) {
      for (const column of this.data) column.copyWithin(0, this.kept, 2 * this.kept);
      this.end = this.kept;
      this.start = 0;
    }
    for (let number = 0; number < this.width; number++) {
      const item = row[number];
      this.data[number][this.end] = item === null ? NaN : item;
    }
    this.end += 1;
    if (this.end - this.start > this.kept) this.start += 1;
  }

  get length() {
    return this.end - this.start;
  }

  column(name) {
    return this.data[this.index[name]];
  }

  at(position, name) {
    return this.data[this.index[name]][position];
  }

  // Whether a row is of a frame; the others are changes to a mode without frames.
  isFrame(position) {
    return !Number.isNaN(this.at(position, "frame"));
  }

  // Position of the last row at or before a time.
  find(time) {
    const times = this.column("run_s");
    let low = this.start;
    let high = this.end;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle + 1;
      else high = middle;
    }
    return Math.max(low - 1, this.start);
  }
}

export class Store {
  constructor() {
    this.hello = null;
    this.rows = null;
    this.reasons = [];
    this.images = []; // {time, head, blob}, oldest first
    this.status = null;
    this.truth = null;
    this.stepping = 0;
    this.cursor = null; // simulation time shown; null: live
    this.listeners = new Map();
  }

  on(what, listener) {
    if (!this.listeners.has(what)) this.listeners.set(what, []);
    this.listeners.get(what).push(listener);
  }

  emit(what, item) {
    for (const listener of this.listeners.get(what) || []) listener(item);
  }

  message(message) {
    switch (message.type) {
      case "hello":
        if (this.cursor !== null) this.scrub(null);
        this.status = null;
        this.hello = message;
        this.rows = new Rows(message.columns, message.kept_rows);
        this.images = [];
        break;
      case "reasons":
        this.reasons = message.reasons;
        break;
      case "status":
        this.status = message.status;
        this.truth = message.truth;
        this.stepping = message.stepping; // speed of a stepped clock; 0: it is stopped
        break;
      case "row":
        this.add(message.row);
        break;
    }
    this.emit(message.type, message);
  }

  history(numbers) {
    const width = this.hello.columns.length;
    for (let start = 0; start + width <= numbers.length; start += width) {
      this.rows.push(numbers.subarray(start, start + width));
    }
    this.emit("rows");
    this.emit("shown");
  }

  // A new page is sent the latest image, whose row is already in the history.
  frame(head, blob) {
    if (!this.rows) return;
    const time = head.row[this.rows.index.run_s];
    if (blob && !(this.images.length && time <= this.images.at(-1).time)) {
      this.images.push({ time, head, blob });
      this.thin(time);
    }
    this.add(head.row);
  }

  add(row) {
    if (!this.rows.length || row[this.rows.index.run_s] > this.now) this.rows.push(row);
    this.emit("rows");
    if (this.cursor === null) this.emit("shown");
  }

  thin(now) {
    const kept = [];
    let last = -Infinity;
    for (const image of this.images) {
      const age = now - image.time;
      if (age > KEPT_S || age < 0) continue;
      if (age > RECENT_S && image.time - last < SPARSE_S) continue;
      last = image.time;
      kept.push(image);
    }
    this.images = kept;
  }

  // Time of the newest row.
  get now() {
    return this.rows && this.rows.length ? this.rows.at(this.rows.end - 1, "run_s") : 0;
  }

  // Simulation time, as last reported.
  get time() {
    return this.status ? Math.max(this.status.run_time_s, this.now) : this.now;
  }

  // Whether no image has come for a while, or the device takes none.
  get imageless() {
    return !this.rows || !this.rows.length || !this.rows.isFrame(this.rows.end - 1) || this.time - this.now > OVERDUE_S;
  }

  // Position of the row that is shown.
  get position() {
    if (!this.rows || !this.rows.length) return -1;
    return this.cursor === null ? this.rows.end - 1 : this.rows.find(this.cursor);
  }

  // Time of the last valid attitude up to the row that is shown; null if there is none.
  get lastValid() {
    let { position } = this;
    while (this.rows && position >= this.rows.start && this.rows.at(position, "valid") !== 1) position -= 1;
    return this.rows && position >= this.rows.start ? this.rows.at(position, "run_s") : null;
  }

  // The image nearest to the shown time.
  get image() {
    const { images } = this;
    if (!images.length) return null;
    if (this.cursor === null) return images[images.length - 1];
    let best = images[0];
    for (const image of images) if (Math.abs(image.time - this.cursor) < Math.abs(best.time - this.cursor)) best = image;
    return best;
  }

  scrub(time) {
    this.cursor = time === null || !this.rows || !this.rows.length ? null : Math.min(Math.max(time, this.rows.at(this.rows.start, "run_s")), this.now);
    this.emit("cursor");
    this.emit("shown");
  }

  // Move by frames.
  step(count) {
    if (!this.rows || !this.rows.length) return;
    const position = Math.min(Math.max(this.position + count, this.rows.start), this.rows.end - 1);
    this.scrub(this.rows.at(position, "run_s"));
  }
}
