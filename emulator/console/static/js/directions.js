// Directions between the sky and the sensor frame: with the attitude q, s = q v q*.

const RAD = Math.PI / 180;

// A direction in the sensor frame, of any length, as right ascension and declination.
export function toSky([a, b, c], [x, y, z, w]) {
  const length = Math.hypot(a, b, c);
  const v = turned([a / length, b / length, c / length], [-x, -y, -z, w]);
  return [(Math.atan2(v[1], v[0]) / RAD + 360) % 360, Math.asin(Math.max(-1, Math.min(1, v[2]))) / RAD];
}

// Right ascension and declination as a unit vector in the sensor frame.
export function toSensor([ra, dec], attitude) {
  const level = Math.cos(dec * RAD);
  return turned([level * Math.cos(ra * RAD), level * Math.sin(ra * RAD), Math.sin(dec * RAD)], attitude);
}

function turned(s, [x, y, z, w]) {
  const q = [x, y, z];
  const cross = (m, n) => [m[1] * n[2] - m[2] * n[1], m[2] * n[0] - m[0] * n[2], m[0] * n[1] - m[1] * n[0]];
  const t = cross(q, s).map((item) => 2 * item);
  const u = cross(q, t);
  return s.map((item, i) => item + w * t[i] + u[i]);
}
