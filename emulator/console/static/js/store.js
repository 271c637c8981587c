// Data of the page: the description of the run, and numbers and images of the last hour.

const RECENT_S = 60; // every image of the last minute is kept …
const SPARSE_S = 5; // … and one in five seconds of the last hour
const KEPT_S = 3600;
const OVERDUE_S = 10; // age at which the newest frame is of the past

const TIMES = 2; // columns in double precision, which come first

// Rows of numbers by column, in rings; `start` to before `end` are the numbers of the rows. Rows may come in any order: those that
// are missing have the time of the row before and no other numbers.
class Rows {
  constructor(columns, kept) {
    this.kept = kept;
    this.index = Object.fromEntries(columns.map((name, number) => [name, number]));
    this.data = columns.map((_, number) => (number < TIMES ? new Float64Array(kept) : new Float32Array(kept)));
    this.start = 0;
    this.end = 0;
  }

  // Take rows from a block: the times of all rows, then their other columns. Returns where the block ends.
  read(buffer, offset, first, count) {
    const others = this.data.length - TIMES;
    const middle = offset + 8 * TIMES * count;
    const end = middle + 4 * others * count;
    if (!count) return end;
    if (!this.length) this.start = this.end = first;
    for (; this.end < first; this.end++) this.miss(this.end);
    const times = new Float64Array(buffer.slice(offset, middle));
    const numbers = new Float32Array(buffer.slice(middle, end));
    for (let row = 0; row < count; row++) {
      const at = (first + row) % this.kept;
      for (let column = 0; column < TIMES; column++) this.data[column][at] = times[row * TIMES + column];
      for (let column = 0; column < others; column++) this.data[TIMES + column][at] = numbers[row * others + column];
    }
    this.start = Math.min(this.start, first);
    this.end = Math.max(this.end, first + count);
    this.start = Math.max(this.start, this.end - this.kept);
    return end;
  }

  miss(number) {
    const at = number % this.kept;
    for (const column of this.data) column[at] = NaN;
    this.data[0][at] = number > this.start ? this.data[0][(number - 1) % this.kept] : -Infinity;
  }

  get length() {
    return this.end - this.start;
  }

  at(number, name) {
    return this.data[this.index[name]][number % this.kept];
  }

  // Whether a row is of a frame; the others are changes to a mode without frames, or missing.
  isFrame(number) {
    return !Number.isNaN(this.at(number, "frame"));
  }

  // Number of the last row at or before a time.
  find(time) {
    let low = this.start;
    let high = this.end;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.at(middle, "run_s") <= time) low = middle + 1;
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
    this.events = []; // oldest first
    this.samples = new Map(); // by telemetry row: [time, values], oldest first
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
        this.begin(message);
        return;
      case "reasons":
        this.reasons = message.reasons;
        break;
      case "status":
        this.status = message.status;
        this.truth = message.truth;
        this.stepping = message.stepping; // speed of a stepped clock; 0: it is stopped
        break;
      case "events":
        this.addEvents(message.items);
        break;
      case "telemetry":
        this.addSamples(message);
        break;
    }
    this.emit(message.type, message);
  }

  // The description of a run. After a reconnection to the same run everything is kept.
  begin(hello) {
    const same = this.hello !== null && this.hello.run_id === hello.run_id && this.hello.head === hello.head;
    this.hello = hello;
    if (!same) {
      if (this.cursor !== null) this.scrub(null);
      this.status = null;
      this.rows = new Rows(hello.columns, hello.kept_rows);
      this.images = [];
      this.events = [];
      this.samples.clear();
      this.emit("hello", hello);
    }
    this.emit("connected", hello);
    if (!same) this.emit("shown");
  }

  // Numbers of the next row and the next event that the page lacks.
  known() {
    return { history: this.rows ? this.rows.end : 0, events: this.events.length ? this.events.at(-1).n + 1 : 0 };
  }

  read(buffer, offset, first, count) {
    const end = this.rows.read(buffer, offset, first, count);
    if (count) {
      this.emit("rows");
      if (this.cursor === null) this.emit("shown");
    }
    return end;
  }

  // A new page is sent the latest image, whose row may come later.
  addImage(head, blob) {
    const time = head.row[this.rows.index.run_s];
    if (this.images.length && time <= this.images.at(-1).time) return;
    this.images.push({ time, head, blob });
    this.thin(time);
    if (this.cursor === null) this.emit("shown");
  }

  addEvents(items) {
    const known = new Set(this.events.map((event) => event.n));
    this.events.push(...items.filter((event) => !known.has(event.n)));
    this.events.sort((a, b) => a.n - b.n);
  }

  // Values of telemetry fields, by row: the times, and the values by field.
  addSamples({ row, values, outcome }) {
    if (outcome !== "ok" || !this.status) return;
    if (!this.samples.has(row)) this.samples.set(row, []);
    const samples = this.samples.get(row);
    samples.push([this.time, values]);
    if (samples.length > KEPT_S) samples.shift();
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

  // The moment that a live plot ends at.
  get present() {
    return this.imageless ? this.time : this.now;
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
