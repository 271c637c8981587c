// Numbers as text of fixed width, so that the layout does not move when they change.

const MINUS = "−";

export function fixed(value, digits, width = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–".padStart(width);
  const text = Math.abs(value).toFixed(digits);
  const sign = value < 0 && Number(text) !== 0 ? MINUS : "";
  return (sign + text).padStart(width);
}

// An angle; right ascensions that are rounded to a full turn are zero.
export function degrees(value, digits) {
  if (!Number.isFinite(value)) return "–";
  return `${fixed(Math.abs(360 - value) < 0.5 * 10 ** -digits ? 0 : value, digits, digits + 5)}°`;
}

// A roll between −180° and 180°: near zero it does not jump to 360°.
export function signed(angle) {
  return angle > 180 ? angle - 360 : angle;
}

export function duration(seconds) {
  const whole = Math.floor(Math.abs(seconds));
  const part = (n) => String(n).padStart(2, "0");
  const tenth = Math.floor((Math.abs(seconds) - whole) * 10);
  return `${part(Math.floor(whole / 3600))}:${part(Math.floor(whole / 60) % 60)}:${part(whole % 60)}.${tenth}`;
}

// The age of something, rounded.
export function age(seconds) {
  if (seconds < 100) return `${Math.max(0, Math.round(seconds))} s`;
  return seconds < 6000 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}

export function utc(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  return new Date(seconds * 1000).toISOString().slice(0, 19).replace("T", " ");
}

export function wall(seconds) {
  const date = new Date(seconds * 1000);
  return date.toTimeString().slice(0, 8) + "." + String(date.getMilliseconds()).padStart(3, "0");
}

// A telemetry value in at most 14 characters.
export function value(item, field) {
  if (item === null || item === undefined) return "–";
  if (typeof item === "boolean") return item ? "yes" : "no";
  if (typeof item !== "number") return String(item);
  if (Number.isInteger(item) && (!field || field.kind !== "float")) return String(item).replace("-", MINUS);
  const size = Math.abs(item);
  if (size !== 0 && (size < 1e-4 || size >= 1e10)) return item.toExponential(5).replace(/-/g, MINUS);
  const digits = size >= 1e6 ? 3 : size >= 100 ? 4 : 7;
  return fixed(item, digits);
}

export function limits(field) {
  if (field.values) return `${field.values.length} values`;
  if (field.min === undefined) return "";
  return `${short(field.min)} … ${short(field.max)}`;
}

export function short(number) {
  if (number === null || number === undefined) return "";
  if (typeof number === "string") return number.replace("-", MINUS); // too large for a number of the page
  const text = Number.isInteger(number) ? String(number) : String(Number(number.toPrecision(6)));
  return text.replace("-", MINUS);
}

// An element with attributes, listeners (on…) and children.
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, item] of Object.entries(attributes)) {
    if (item === undefined || item === null || item === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), item);
    else if (name === "class") element.className = item;
    else if (name === "text") element.textContent = item;
    else element.setAttribute(name, item === true ? "" : item);
  }
  element.append(...children);
  return element;
}

// A name with underscores, after which a line may break.
export function name(text) {
  return text.split("_").flatMap((part, i) => (i ? ["_", document.createElement("wbr"), part] : [part]));
}

// Show whether a button is on.
export function press(button, on) {
  button.classList.toggle("on", on);
  button.setAttribute("aria-pressed", String(on));
}

export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// Show another value in a field. If all of the old text is selected, what is typed next still replaces it.
export function setValue(field, value) {
  if (field.value === value) return;
  const selected = document.activeElement === field && field.selectionEnd - field.selectionStart === field.value.length;
  field.value = value;
  if (selected) field.select();
}

// Tell those who hear the page the outcome of what they did.
export function say(text) {
  if (text) document.getElementById("said").textContent = text;
}

// Offer a file that the page has made.
export function save(name, blob) {
  const url = URL.createObjectURL(blob);
  make("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 1000);
}

// Text with `code` in it, as elements.
export function prose(text) {
  return text.split("`").map((part, number) => (number % 2 ? make("code", { text: part }) : part));
}

// The number in a field, or a reason why it is none, or not in its range.
export function number(text, low, high) {
  const item = Number(text);
  if (text.trim() === "" || !Number.isFinite(item)) return { problem: `“${text}” is not a number` };
  if (low !== undefined && low !== null && item < Number(low)) return { item, problem: `${text} is below ${short(low)}` };
  if (high !== undefined && high !== null && item > Number(high)) return { item, problem: `${text} is above ${short(high)}` };
  return { item, problem: "" };
}

// Ask before something that cannot be taken back; resolve with the answer chosen, "" for none.
export function ask(text, ...answers) {
  const dialog = document.getElementById("ask");
  document.getElementById("ask-text").textContent = text;
  dialog.querySelector("form").replaceChildren(
    ...answers.map((answer) => make("button", { value: answer, class: "primary", text: answer })), make("button", { value: "", text: "cancel" }));
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue), { once: true }));
}
