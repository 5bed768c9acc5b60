// Small algebra: vectors are arrays of 3, quaternions (x, y, z, w), matrices column-major as WebGL wants them.
"use strict";
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = a => scale(a, 1 / (Math.hypot(...a) || 1));
const turn = (q, v) => { const t = scale(cross(q, v), 2); return add(add(v, t, q[3]), cross(q, t)); };
const qmul = (a, b) => [...add(add(scale(b, a[3]), a, b[3]), cross(a, b)), a[3] * b[3] - dot(a, b)];
const qaxis = (axis, angle) => [...scale(axis, Math.sin(angle / 2)), Math.cos(angle / 2)];
const qunit = q => { const n = Math.hypot(...q) || 1; return q.map(v => v / n); };
function qaxes(x, y, z) {  // the rotation whose columns are x, y, z
  const w = 1 + x[0] + y[1] + z[2];
  if (w > 0.1) return qunit([y[2] - z[1], z[0] - x[2], x[1] - y[0], w]);
  if (x[0] >= y[1] && x[0] >= z[2]) return qunit([1 + x[0] - y[1] - z[2], x[1] + y[0], z[0] + x[2], y[2] - z[1]]);
  if (y[1] >= z[2]) return qunit([x[1] + y[0], 1 - x[0] + y[1] - z[2], y[2] + z[1], z[0] - x[2]]);
  return qunit([z[0] + x[2], y[2] + z[1], 1 - x[0] - y[1] + z[2], x[1] - y[0]]);
}
function qblend(a, b, s) {
  if (a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0) b = b.map(v => -v);
  return qunit(a.map((v, i) => v * (1 - s) + b[i] * s));
}
function half(bits) {  // a 16-bit float
  const exponent = bits >> 10 & 31, fraction = bits & 1023;
  return (bits >> 15 ? -1 : 1) * (exponent ? 2 ** (exponent - 25) * (1024 + fraction) : 2 ** -24 * fraction);
}
function nice(value) {  // 1, 2 or 5 times a power of ten, the largest not above the value
  const power = 10 ** Math.floor(Math.log10(value));
  return (value >= 5 * power ? 5 : value >= 2 * power ? 2 : 1) * power;
}
