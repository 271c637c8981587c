// Dark or light theme: the user's choice, or else the system's.

const listeners = [];

export function initTheme(button) {
  const saved = localStorage.getItem("starhil-theme");
  const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
  document.documentElement.dataset.theme = saved || system;
  button.addEventListener("click", toggleTheme);
}

function toggleTheme() {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("starhil-theme", next);
  for (const listener of listeners) listener();
}

export function onTheme(listener) {
  listeners.push(listener);
}

export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

// Line widths and marks scale with the font size, so that they are visible on a large screen too.
export function pen() {
  return Math.max(1, parseFloat(getComputedStyle(document.documentElement).fontSize) / 12.5);
}
