// Builds the page from the record in #data. Every string of it is set as text, never as
// markup: names in a run folder are user input.

"use strict";

const DATA = JSON.parse(document.getElementById("data").textContent);
const RUNS = DATA.runs;
const PALETTE = ["#2563eb", "#0891b2", "#c2410c", "#d97706", "#7c3aed", "#db2777", "#15803d", "#65a30d", "#475569", "#b91c1c"];
const PHASES = { supporting: "#16a34a", "reach-to-supportable": "#eab308", sliding: "#4f46e5" };
const PHASE_NAMES = { supporting: "supporting", "reach-to-supportable": "reach-to-support", sliding: "beyond the contact-angle guide value" };
const NONE = -32768;

// An element with attributes, listeners (`onclick`) and children; text is text.
function el(tag, attributes = {}, ...children) {
  const svg = ["svg", "path", "rect", "line"].includes(tag);
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "style") Object.entries(value).forEach(([k, v]) => made.style.setProperty(k, v));
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.flat(Infinity).filter((c) => c !== null && c !== undefined && c !== false));
  return made;
}

const fixed = (x, digits) => (x === null || Number.isNaN(x) ? "–" : x.toFixed(digits).replace(/^-(0\.?0*)$/, "$1"));
const neat = (x) => {
  if (typeof x !== "number") return String(x ?? "–");
  const short = Number.isInteger(x) ? x : Number(x.toPrecision(4));
  return short !== 0 && Math.abs(short) < 1e-3 ? short.toExponential() : String(short);
};

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

// {data, scale, columns} -> (row, column) => number, NaN where there is none.
function unpacked(packed) {
  const values = new Int16Array(bytes(packed.data).buffer), { scale, columns } = packed;
  const at = (row, column = 0) => { const x = values[row * columns + column]; return x === NONE ? NaN : x * scale; };
  return Object.assign(at, { rows: values.length / columns, columns });
}

// The last index whose time is not after t.
function before(times, t) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t + 1e-9) low = middle; else high = middle - 1;
  }
  return low;
}

function posed(array, row, next, share, body) {
  const x = [];
  const side = [3, 4, 5, 6].reduce((sum, k) => sum + array(row, 7 * body + k) * array(next, 7 * body + k), 0) < 0 ? -1 : 1;
  for (let k = 0; k < 7; k++)
    x.push(array(row, 7 * body + k) * (1 - share) + array(next, 7 * body + k) * share * (k > 2 ? side : 1));
  return x;
}

function rigid([x, y, z, qw, qx, qy, qz], scale) {
  const l = Math.hypot(qw, qx, qy, qz) || 1, w = qw / l, a = qx / l, b = qy / l, c = qz / l;
  return frame(
    [1 - 2 * (b * b + c * c), 2 * (a * b + c * w), 2 * (a * c - b * w)],
    [2 * (a * b - c * w), 1 - 2 * (a * a + c * c), 2 * (b * c + a * w)],
    [2 * (a * c + b * w), 2 * (b * c - a * w), 1 - 2 * (a * a + b * b)],
    [x * scale, y * scale, z * scale]);
}

// What is drawn of a run at a time, or at a keyframe.
function motionOf(run) {
  const m = run.motion;
  if (!m) return null;
  const times = [...new Float32Array(bytes(m.times).buffer)];
  const arrays = Object.fromEntries(Object.entries(m.arrays).map(([k, v]) => [k, v && unpacked(v)]));
  const count = m.meshes.length, identity = frame([1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]);
  const meshes = m.meshes.map((x) => ({
    body: x.body, scale: x.scale, vertices: new Int16Array(bytes(x.vertices).buffer), normals: new Int8Array(bytes(x.normals).buffer),
    colours: bytes(x.colours), triangles: new Uint32Array(bytes(x.triangles).buffer),
  }));
  const matrices = (array, row, next, share) =>
    meshes.map((x, i) => (x.body === 0 ? identity : rigid(posed(array, row, next, share, i), m.reach)));
  const hex = (c) => [1, 3, 5].map((i) => (parseInt(c.slice(i, i + 2), 16) / 255) ** 2);
  const phase = (loaded, ratio) => (loaded ? (ratio <= 1 ? "supporting" : "sliding") : ratio <= 1 ? "reach-to-supportable" : "sliding");
  function at(t, ghost) {
    const row = before(times, t), next = Math.min(row + 1, times.length - 1);
    const share = m.stills || next === row ? 0 : Math.min(1, Math.max(0, (t - times[row]) / (times[next] - times[row])));
    const discs = [], arrows = [];
    m.surfaces.forEach((name, j) => {
      const planned = arrays.planned ? arrays.planned(row, j) > 0 : false;
      const loaded = arrays.loaded ? arrays.loaded(row, j) > 0 : planned;
      if (!planned && !loaded) return;
      const p = [0, 1, 2].map((k) => arrays.points(row, 3 * j + k)), n = m.supports[arrays.support(row, j)].normal;
      const colour = hex(PHASES[phase(loaded, arrays.ratio(row, j))]);
      discs.push({ p, n, colour });
      if (!arrays.force || !loaded) return;
      const f = [0, 1, 2].map((k) => (arrays.force(row, 3 * j + k) / m.weight) * m.forceLength);
      if (Math.hypot(...f) > 0.01) arrows.push({ p, f, colour });
    });
    if (arrays.push) {
      const f = [0, 1, 2].map((k) => (arrays.push(row, k) / m.weight) * 4 * m.forceLength);
      if (Math.hypot(...f) > 0.005) arrows.push({ p: V.sub([0, 1, 2].map((k) => arrays.base(row, k)), f), f, colour: hex("#a21caf") });
    }
    return { poses: matrices(arrays.poses, row, next, share), ghost: ghost && arrays.ghost ? matrices(arrays.ghost, row, next, share) : null, discs, arrows };
  }
  function keyframe(i) {
    const discs = [], arrows = [];
    for (const c of run.keyframes[i].contacts) {
      const colour = hex(PHASES[c.phase] || "#64748b");
      const n = (m.supports.find((s) => s.name === c.support) || { normal: [0, 0, 1] }).normal;
      discs.push({ p: c.position, n, colour });
      if (c.force) arrows.push({ p: c.position, f: V.scale(c.force, m.forceLength / m.weight), colour });
    }
    return { poses: matrices(arrays.keyposes, i, i, 0), ghost: null, discs, arrows };
  }
  return { ...m, times, arrays, meshes, end: times[times.length - 1], at, keyframe, count };
}

const MOTIONS = RUNS.map(motionOf);
const END = Math.max(0, ...MOTIONS.map((m) => (m ? m.end : 0)));
const state = { t: 0, playing: false, speed: END > 40 ? 4 : END > 20 ? 2 : 1, ghost: false, camera: null, azimuth: DATA.presets[0] };
const watchers = [];  // told of each new time
const SCENES = [];

// Long runs open at once: what is far from the screen is made when it comes near, or for
// paper; of long lists one page is on the screen.
const LATER = new Map(), PAGED = [];
const near = new IntersectionObserver((seen) => seen.forEach((e) => e.isIntersecting && makeNow(e.target)), { rootMargin: "300px" });
function later(place, make) {
  LATER.set(place, make);
  near.observe(place);
  return place;
}
function makeNow(place) {
  const make = LATER.get(place);
  LATER.delete(place);
  near.unobserve(place);
  if (make) make();
}
// `fill(from, to)` shows items of a list; the buttons below say which.
function paged(count, size, fill) {
  if (count <= size) { fill(0, count); return null; }
  const label = el("output"), turn = (way) => { first = Math.min(Math.max(0, first + way * size), Math.floor((count - 1) / size) * size); show(); };
  let first = 0;
  const button = (text, title, way) => el("button", { type: "button", "aria-label": title, title, onclick: () => turn(way) }, text);
  const before = button("◀", "earlier", -1), after = button("▶", "later", 1);
  const show = () => {
    const last = Math.min(first + size, count);
    [before.disabled, after.disabled] = [first === 0, last === count];
    label.textContent = `${first} to ${last - 1} of 0 to ${count - 1}`;
    fill(first, last);
  };
  PAGED.push({ all: () => fill(0, count), show });
  show();
  return el("div", { class: "pager" }, before, label, after);
}

const night = matchMedia("(prefers-color-scheme: dark)");
let printing = false;
function theme() {
  const linear = (...c) => c.map((x) => (x / 255) ** 2);
  return night.matches && !printing
    ? { base: linear(30, 35, 43), lines: linear(62, 70, 82), sky: [0.34, 0.37, 0.43], earth: [0.13, 0.12, 0.12], ghost: linear(96, 165, 250) }
    : { base: linear(236, 239, 243), lines: linear(198, 204, 213), sky: [0.5, 0.54, 0.6], earth: [0.25, 0.23, 0.21], ghost: linear(59, 130, 246) };
}

// Frames: at most one redraw a frame of the screen, none while nothing changes.
let asked = false;
function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => { asked = false; paint(); });
}
function paint() {
  for (const s of SCENES) {
    const ratio = Math.min(2, devicePixelRatio || 1), box = s.canvas.getBoundingClientRect();
    const width = Math.max(2, Math.round(box.width * ratio)), height = Math.max(2, Math.round(box.height * ratio));
    s.scene.draw(s.motion.at(state.t, state.ghost), cameraOf(s, width / height), theme(), width, height);
  }
}
function cameraOf(s, aspect) {
  return state.camera || s.scene.fit(state.azimuth.azimuth, state.azimuth.elevation, aspect);
}
function go(t) {
  state.t = Math.min(END, Math.max(0, t));
  watchers.forEach((tell) => tell(state.t));
  redraw();
}
function play(on) {
  if (on && state.t >= END) go(0);
  state.playing = on && END > 0;
  document.body.classList.toggle("playing", state.playing);
  let last = null;
  const step = (now) => {
    if (!state.playing) return;
    if (last !== null) go(state.t + Math.min(0.25, (now - last) / 1000) * state.speed);
    last = now;
    if (state.t >= END) return play(false);
    requestAnimationFrame(step);
  };
  if (state.playing) requestAnimationFrame(step);
}
const EVENTS = [...new Set(MOTIONS.flatMap((m) => (m ? m.events : [])))].sort((a, b) => a - b);
function step(way) {
  play(false);
  const found = way > 0 ? EVENTS.find((t) => t > state.t + 0.02) : EVENTS.filter((t) => t < state.t - 0.02).pop();
  go(found ?? (way > 0 ? END : 0));
}
const jump = (t) => () => {
  play(false);
  go(t);
  const stage = document.querySelector(".stage");
  if (stage && stage.getBoundingClientRect().bottom < 120) stage.scrollIntoView({ behavior: "smooth", block: "start" });
};

// The sections, one column a run.
const columns = (className, make) => el("div", { class: `runs ${className}` }, RUNS.map((run, i) => el("div", { class: "run" }, make(run, MOTIONS[i], i))));
function section(title, className, make, note) {
  return el("section", { class: className }, el("h2", {}, title), note && el("p", { class: "note" }, note), columns("", make));
}

function heading(run, motion) {
  const badge = run.reached === null ? ["plan only", "open"] : run.reached ? ["reached the goal", "good"] : ["failed", "bad"];
  const facts = [];
  if (motion && !motion.stills) facts.push(`${fixed(motion.end, 1)} s`);
  if (run.keyframes.length) facts.push(`${run.keyframes.length} stances`);
  if (run.mass) facts.push(`${fixed(run.mass, 1)} kg`);
  facts.push(...run.facts);
  return [
    el("h1", {}, run.title),
    el("p", { class: "lead" }, el("span", { class: `badge ${badge[1]}` }, badge[0]), ` ${facts.join(" · ")}`),
    run.stopped && el("p", { class: "warn" }, `Stopped on the way: ${run.stopped}`),
    run.fell && el("p", { class: "warn" }, "The robot fell; the run ends there."),
    run.instead && el("p", { class: "note" }, run.instead),
    run.adapted && el("p", { class: "note" }, "The plan was adapted during execution: “planned” below is what was followed in the end."),
    run.missing.map((text) => el("p", { class: "warn missing" }, text)),
  ];
}

function stage(run, motion, i) {
  if (!motion) return el("p", { class: "warn" }, "Nothing to animate.");
  const canvas = el("canvas", { class: "view", "aria-label": `animation of ${run.title}`, tabindex: "0" });
  let scene = null, reason = "WebGL 2 is not available here: no animation.";
  try { scene = createScene(canvas, motion.meshes, motion.edges, motion.seen, motion.start); } catch (e) { reason = `${reason} ${e.message}`; }
  if (!scene) return el("p", { class: "warn" }, reason);
  const made = { canvas, scene, motion, run };
  SCENES.push(made);
  orbit(canvas, () => state.camera || cameraOf(made, canvas.clientWidth / canvas.clientHeight), (camera) => { state.camera = camera; redraw(); });
  canvas.addEventListener("dblclick", () => { state.camera = null; redraw(); });
  new ResizeObserver(redraw).observe(canvas);
  const legend = el("div", { class: "key" },
    Object.entries(PHASES).map(([name, colour]) => el("span", {}, el("i", { style: { background: colour } }), PHASE_NAMES[name])),
    motion.arrays.force && el("span", {}, "arrows: contact forces"));
  const caption = el("div", { class: "caption" });
  watchers.push((t) => {
    const shown = run.keyframes.filter((k) => k.time !== null && k.time <= t + 1e-6).pop();
    const clock = motion.stills ? `keyframe ${before(motion.times, t)}` : `${fixed(Math.min(t, motion.end), 2)} s`;
    caption.textContent = shown && !motion.stills ? `${clock} — after: ${shown.move}` : clock;
  });
  made.paper = el("canvas", { class: "paper", "aria-hidden": "true" });
  return [el("div", { class: "stage" }, canvas, made.paper, caption), legend];
}

function transport() {
  const slider = el("input", { type: "range", min: 0, max: END, step: 0.001, value: 0, "aria-label": "time", oninput: () => { play(false); go(Number(slider.value)); } });
  const clock = el("output", { id: "clock" });
  watchers.push((t) => { slider.value = t; clock.textContent = `${fixed(t, 2)} / ${fixed(END, 1)} s`; });
  const button = (label, title, act, id) => el("button", { type: "button", title, "aria-label": title, id, onclick: act }, label);
  const toggle = button("", "play or pause (space)", () => play(!state.playing), "play");
  const speed = el("select", { "aria-label": "speed", id: "speed", onchange: () => { state.speed = Number(speed.value); } },
    [0.1, 0.25, 0.5, 1, 2, 4, 8, 16].map((x) => el("option", { value: x, selected: x === state.speed }, `${x}×`)));
  const view = (preset) => button(preset.name, `camera: ${preset.name}`, () => { state.azimuth = preset; state.camera = null; redraw(); });
  const ghost = MOTIONS.some((m) => m && m.arrays.ghost);
  const tick = el("input", { type: "checkbox", id: "ghost", onchange: () => { state.ghost = tick.checked; redraw(); } });
  return el("div", { class: "transport" },
    el("div", { class: "row" }, button("|◀", "contact before (←)", () => step(-1), "previous"), toggle, button("▶|", "next contact (→)", () => step(1), "next"), slider, clock, speed),
    el("div", { class: "row views" }, DATA.presets.map(view), ghost && el("label", {}, tick, " planned posture"),
      el("span", { class: "hint" }, "drag to turn, Shift-drag to move, wheel or pinch to zoom")));
}

// A strip over time: an SVG without proportions below HTML labels; a cursor; dragging scrubs.
function strip(end, height, ...shapes) {
  const svg = el("svg", { viewBox: `0 0 1000 ${height}`, preserveAspectRatio: "none", "aria-hidden": "true" }, shapes);
  const cursor = el("div", { class: "cursor" });
  const chart = el("div", { class: "chart", style: { height: `${height}px` } }, svg, cursor);
  watchers.push((t) => { cursor.style.left = `${(100 * Math.min(t, end)) / (end || 1)}%`; });
  const scrub = (e) => {
    const box = chart.getBoundingClientRect();
    go((end * (e.clientX - box.left)) / box.width);
  };
  chart.addEventListener("pointerdown", (e) => { play(false); chart.setPointerCapture(e.pointerId); scrub(e); });
  chart.addEventListener("pointermove", (e) => { if (e.buttons || e.pressure > 0) scrub(e); });
  return chart;
}

function ticks(low, high, wanted) {
  const rough = (high - low) / wanted || 1, power = 10 ** Math.floor(Math.log10(rough));
  const size = [1, 2, 5, 10].map((x) => x * power).find((x) => x >= rough);
  const out = [];
  for (let x = Math.ceil(low / size) * size; x <= high + size * 1e-6; x += size) out.push(Math.abs(x) < size * 1e-6 ? 0 : x);
  return out;
}

function timeAxis(end) {
  return el("div", { class: "axis" }, ticks(0, end, 8).map((t) => el("span", { style: { left: `${(100 * t) / (end || 1)}%` } }, neat(t))));
}

function gantt(run, motion) {
  if (!motion || motion.stills) return el("p", { class: "note" }, "No motion, no timeline.");
  const row = 22, shapes = [], names = motion.surfaces, x = (t) => (1000 * t) / (motion.end || 1);
  names.forEach((name, j) => {
    const y = j * row, colour = PALETTE[j % PALETTE.length];
    shapes.push(el("line", { x1: 0, x2: 1000, y1: y + row, y2: y + row, class: "rule" }));
    for (const [a, b] of motion.schedule[j]) shapes.push(el("rect", { x: x(a), width: Math.max(0.6, x(b) - x(a)), y: y + 3, height: 5, class: "planned" }));
    if (motion.loads) for (const [a, b] of motion.loads[j]) shapes.push(el("rect", { x: x(a), width: Math.max(0.6, x(b) - x(a)), y: y + 9, height: 10, fill: colour }));
  });
  run.keyframes.forEach((k) => k.time !== null && shapes.push(el("line", { x1: x(k.time), x2: x(k.time), y1: 0, y2: names.length * row, class: "mark" })));
  motion.felt.forEach((t) => shapes.push(el("line", { x1: x(t), x2: x(t), y1: 0, y2: names.length * row, class: "felt" })));
  return el("div", { class: "gantt" },
    el("div", { class: "names" }, names.map((name) => el("span", {}, name))),
    el("div", {}, strip(motion.end, names.length * row, shapes), timeAxis(motion.end)),
    el("p", { class: "note" }, `Thin: planned. ${motion.loads ? "Bold: loaded in physics, gaps and touches below 60 ms left out. " : ""}Dashed lines: keyframes.${motion.felt.length ? " Red: an event of the execution." : ""} Time in s; drag to scrub.`));
}

// A plot of lines {name, at: row => number, colour, faint, dashed, bold: row => bool}.
// Of more samples than the screen has columns, the lowest and the highest of each column.
const COLUMNS = 500;
function plot(title, motion, lines, values, { limits = [], range: [low, high], digits = 2 }) {
  const height = 150, n = motion.times.length, wide = Math.ceil(n / COLUMNS);
  const y = (v) => height - (height * (v - low)) / (high - low || 1), x = (r) => (1000 * motion.times[r]) / (motion.end || 1);
  const shapes = ticks(low, high, 4).map((v) => el("line", { x1: 0, x2: 1000, y1: y(v), y2: y(v), class: "rule" }));
  limits.forEach(({ value, colour }) => shapes.push(el("line", { x1: 0, x2: 1000, y1: y(value), y2: y(value), class: "limit", stroke: colour || "#dc2626" })));
  const pathOf = (v, keep) => {
    let d = "", pen = false, least = -1, most = -1;
    const put = () => {
      for (const r of least < 0 ? [] : new Set([Math.min(least, most), Math.max(least, most)])) {
        d += `${pen ? "L" : "M"}${x(r).toFixed(1)} ${y(v[r]).toFixed(1)}`;
        pen = true;
      }
      least = most = -1;
    };
    for (let r = 0; r < n; r++) {
      if (Number.isNaN(v[r]) || (keep && !keep(r))) { put(); pen = false; continue; }
      if (least < 0 || v[r] < v[least]) least = r;
      if (most < 0 || v[r] > v[most]) most = r;
      if ((r + 1) % wide === 0) put();
    }
    put();
    return d;
  };
  lines.forEach((l, i) => {
    shapes.push(el("path", { d: pathOf(values[i]), stroke: l.colour, class: l.faint ? "faint" : l.dashed ? "dashed" : "" }));
    if (l.bold) shapes.push(el("path", { d: pathOf(values[i], l.bold), stroke: l.colour, class: "bold" }));
  });
  const readings = lines.map((l) => (l.faint ? null : el("b")));
  const legend = el("div", { class: "legend" }, lines.map((l, i) => !l.faint && el("span", {}, el("i", { style: { background: l.colour } }), l.name, " ", readings[i])),
    limits.map((l) => l.name && el("span", {}, el("i", { class: "dash", style: { "border-color": l.colour || "#dc2626" } }), l.name)));
  watchers.push((t) => { const r = before(motion.times, t); readings.forEach((b, i) => b && (b.textContent = fixed(values[i][r], digits))); });
  const chart = strip(motion.end, height, shapes);
  chart.append(...ticks(low, high, 4).map((v) => el("span", { class: "tick", style: { top: `${(100 * y(v)) / height}%` } }, neat(v))));
  return el("figure", { class: "plot" }, el("figcaption", {}, title), legend, chart, timeAxis(motion.end));
}

const colourOf = (j) => PALETTE[j % PALETTE.length];
// What can be plotted: title, and for a run its lines and limits, or null.
const PLOTS = [
  ["Joint torque [% of its limit]", (run, m) => {
    if (!m.arrays.effort) return null;
    const peaks = m.joints.map((j, i) => [i, Math.max(...m.times.map((_, r) => Math.abs(m.arrays.effort(r, i))))]).sort((a, b) => b[1] - a[1]);
    const most = peaks.slice(0, 5).map(([i]) => i), lines = [];
    m.joints.forEach((name, i) => most.includes(i) || lines.push({ name, faint: true, colour: "#94a3b8", at: (r) => 100 * m.arrays.effort(r, i) }));
    most.forEach((i, k) => lines.push({ name: `${m.joints[i]} (${neat(m.effortLimits[i])} N m)`, colour: colourOf([0, 2, 4, 6, 5][k]), at: (r) => 100 * m.arrays.effort(r, i) }));
    return { lines, limits: [{ value: 100, name: "limit" }, { value: -100 }], at: [-108, 108], digits: 0 };
  }],
  ["CoM margin in the support polygon [m]", (run, m) => {
    if (!m.arrays.margin) return null;
    const lines = [{ name: m.loads ? "measured" : "planned", colour: "#2563eb", at: (r) => m.arrays.margin(r) }];
    if (m.arrays.plannedMargin) lines.unshift({ name: "planned", colour: "#94a3b8", dashed: true, at: (r) => m.arrays.plannedMargin(r) });
    return { lines, limits: [{ value: 0, name: "border" }, { value: m.marginAsked, name: "required at keyframes", colour: "#16a34a" }], digits: 3 };
  }],
  ["Joint tracking error [rad]", (run, m) => m.arrays.error && {
    lines: [{ name: "largest", colour: "#c2410c", at: (r) => m.arrays.error(r, 0) }, { name: "root mean square", colour: "#2563eb", at: (r) => m.arrays.error(r, 1) }], limits: [], floor: 0, digits: 3 }],
  ["Base position error [m]", (run, m) => m.arrays.error && { lines: [{ name: "distance", colour: "#7c3aed", at: (r) => m.arrays.error(r, 2) }], limits: [], floor: 0, digits: 4 }],
  ["Contact forces [N]", (run, m) => {
    if (!m.arrays.size) return null;
    const lines = m.surfaces.map((name, j) => ({ name, colour: colourOf(j), at: (r) => m.arrays.size(r, j) }));
    if (m.arrays.pushSize) lines.push({ name: "push on the pelvis", colour: "#a21caf", at: (r) => m.arrays.pushSize(r) });
    return { lines, limits: [{ value: m.weight, name: "weight", colour: "#64748b" }], floor: 0, digits: 0 };
  }],
  ["Projected distance [% of its guide value]", (run, m) => m.arrays.ratio && {
    lines: m.surfaces.map((name, j) => ({ name, colour: colourOf(j), at: (r) => ((m.arrays.loaded || m.arrays.planned)(r, j) > 0 ? 100 * m.arrays.ratio(r, j) : NaN) })), limits: [{ value: 100, name: "guide value", colour: "#64748b" }], floor: 0, digits: 0 }],
  ["Heights of the arms' surfaces [m]; bold: loaded", (run, m) => heights(m, true)],
  ["Heights of the legs' surfaces [m]; bold: loaded", (run, m) => heights(m, false)],
];

function heights(m, arms) {
  const lines = m.surfaces.map((name, j) => ({ name, j, colour: colourOf(j), at: (r) => m.arrays.points(r, 3 * j + 2), bold: (r) => (m.arrays.loaded || m.arrays.planned)(r, j) > 0 })).filter((l) => m.arms[l.j] === arms);
  return lines.length ? { lines, limits: m.supports.map((s) => ({ value: s.height, name: s.name, colour: "#94a3b8" })), digits: 3 } : null;
}

function plots() {
  const moving = MOTIONS.map((m) => (m && !m.stills ? m : null));
  if (!moving.some(Boolean)) return null;
  const figures = PLOTS.flatMap(([title, make]) => {
    const places = moving.map(() => el("div", { class: "place" }));
    return later(places[0], () => {
      const specs = RUNS.map((run, i) => moving[i] && make(run, moving[i]));
      if (!specs.some(Boolean)) return places.forEach((p) => p.remove());
      const values = specs.map((s, i) => (s ? s.lines.map((l) => moving[i].times.map((_, r) => l.at(r))) : []));
      let low = Infinity, high = -Infinity;
      const take = (v) => { if (!Number.isNaN(v)) [low, high] = [Math.min(low, v), Math.max(high, v)]; };
      specs.forEach((s, i) => { values[i].forEach((line) => line.forEach(take)); if (s) s.limits.forEach((l) => take(l.value)); });
      const { floor, at } = specs.find(Boolean), room = 0.06 * (high - low || 1);
      const range = at && low >= at[0] && high <= at[1] ? at : [floor ?? low - room, high + room];
      specs.forEach((s, i) => s && places[i].replaceWith(plot(title, moving[i], s.lines, values[i], { ...s, range })));
      watchers.forEach((tell) => tell(state.t));
    }), places;
  });
  return el("section", {}, el("h2", {}, "Over time"), el("div", { class: "plots" }, figures));
}

function table(head, rows, className = "") {
  return el("div", { class: "scroll" }, el("table", { class: className }, el("thead", {}, el("tr", {}, head.map((h) => el("th", {}, h)))), el("tbody", {}, rows)));
}
const cells = (values) => values.map((v) => el("td", {}, v instanceof Node ? v : neat(v)));
const clickable = (time, label) => (time === null ? { class: "unreached", title: "not reached" } : { class: "go", tabindex: "0", role: "button", title: `show ${label}`, onclick: jump(time), onkeydown: (e) => e.key === "Enter" && jump(time)() });

function sheet(run, motion, i) {
  const s = SCENES.find((x) => x.run === run);
  if (!s || !run.keyframes.length) return el("p", { class: "note" }, "No keyframes to draw.");
  const tile = (k, n) => {
    const canvas = el("canvas", { width: 480, height: 384, "data-run": i, "data-keyframe": n });
    later(canvas, () => { STILLS.push(canvas); drawStills(); });
    return el("figure", { ...clickable(k.time, `keyframe ${n}`), class: `tile ${k.time === null ? "unreached" : "go"}` }, canvas,
      el("figcaption", {}, el("b", {}, `${n}  ${k.move}`), el("br"), `CoM margin ${millimetres(k.com_margin)} mm, robust ${millimetres(k.robust_margin)} mm, push margin ${fixed(k.margin, 2)} m g`, k.time === null && el("em", {}, " — not reached")));
  };
  const box = el("div", { class: "sheet" });
  return [box, paged(run.keyframes.length, 12, (from, to) => box.replaceChildren(...run.keyframes.slice(from, to).map((k, n) => tile(k, from + n))))];
}

// Stills are drawn by the renderer of the animation, one a frame: keyframes when they are
// seen, anew for another theme, and the present picture for paper, since browsers print an
// older one of a WebGL canvas.
const STILLS = [];
function still(s, onto, picture, camera) {
  s.scene.draw(picture, camera, theme(), onto.width, onto.height);
  onto.getContext("2d").drawImage(s.canvas, 0, 0);
  onto.dataset.drawn = "";
}
function drawStills() {
  const tile = STILLS.shift();
  if (!tile) return;
  if (tile.isConnected) {
    const s = SCENES.find((x) => x.run === RUNS[Number(tile.dataset.run)]), preset = DATA.presets[0];
    still(s, tile, s.motion.keyframe(Number(tile.dataset.keyframe)), s.scene.fit(preset.azimuth, preset.elevation, tile.width / tile.height));
  }
  if (printing) return drawStills();
  paint();
  if (STILLS.length) requestAnimationFrame(drawStills);
}
function restyle() {
  STILLS.push(...document.querySelectorAll("canvas[data-drawn]:not(.paper)"));
  drawStills();
  paint();
}
function paper(on) {
  printing = on;
  PAGED.forEach((list) => (on ? list.all() : list.show()));
  if (on) [...LATER.keys()].forEach(makeNow);
  restyle();
  for (const s of SCENES) {
    [s.paper.width, s.paper.height] = [1600, 800];
    if (on) still(s, s.paper, s.motion.at(state.t, state.ghost), cameraOf(s, 2));
  }
}

function millimetres(x) {
  return x === null ? "–" : fixed(1000 * x, 0);
}

function stances(run) {
  if (!run.keyframes.length) return el("p", { class: "note" }, "No plan.");
  const rows = (k, n) => k.contacts.map((c, j) => el("tr", { ...clickable(k.time, `stance ${n}`), "data-stance": j === 0 ? n : false, class: `${j === 0 ? "first " : ""}${k.time === null ? "unreached" : "go"}` },
    cells([j ? "" : String(n), j ? "" : k.move, j ? "" : k.time === null ? "not reached" : fixed(k.time, 2), c.surface, c.support, fixed(1000 * c.projected_distance, 0), fixed((180 / Math.PI) * c.contact_angle, 1),
      el("span", { class: "phase" }, el("i", { style: { background: PHASES[c.phase] || "#64748b" } }), (PHASE_NAMES[c.phase] || c.phase).replace("contact-angle ", "")), c.force ? fixed(Math.hypot(...c.force), 0) : "–", j ? "" : `${millimetres(k.com_margin)} (${millimetres(k.robust_margin)})`, j ? "" : fixed(k.margin, 2), j ? "" : k.limiting || "–"])));
  const made = table(["", "contact change", "t [s]", "surface", "support", "d [mm]", "θ [°]", "phase", "force [N]", "CoM (robust) [mm]", "push [m g]", "limited by"], [], "stances"), body = made.querySelector("tbody");
  const pager = paged(run.keyframes.length, 20, (from, to) => body.replaceChildren(...run.keyframes.slice(from, to).flatMap((k, n) => rows(k, from + n))));
  const skipped = run.skipped.length ? [el("h3", {}, "Left out"), table(["stance", "reason"], run.skipped.map((s) => el("tr", {}, cells([s.stance, s.reason]))))] : [];
  return [RUNS.length > 1 && el("h3", {}, run.title), made, pager, ...skipped];
}

function verdict(run) {
  if (!run.criteria) return el("p", { class: "note" }, "Not judged: no verdict.");
  return table(["criterion", "value", "limit", ""], run.criteria.map(([label, value, limit, ok]) => el("tr", { class: ok ? "" : "failed" }, cells([label, value, limit, ok ? "ok" : "NO"]))), "verdict");
}
function events(run, motion) {
  if (!run.events.length) return el("p", { class: "note" }, run.reached === null ? "Not run in physics." : "None: the plan was followed unchanged.");
  const time = (t) => (motion && !motion.stills ? t : null);
  const made = table(["t [s]", "measured during execution"], [], "events"), row = (e) => el("tr", clickable(time(e.time), "this event"), cells([fixed(e.time, 2), e.text]));
  return [made, paged(run.events.length, 40, (from, to) => made.querySelector("tbody").replaceChildren(...run.events.slice(from, to).map(row)))];
}
const pairs = (title, rows) => rows.length > 0 && el("div", {}, el("h3", {}, title), table(["", ""], rows.map(([k, v]) => el("tr", {}, cells([k, v]))), "pairs"));

function build() {
  document.body.append(
    el("header", {}, columns("head", heading)),
    el("main", {},
      columns("stages", stage), END > 0 && transport(),
      section("Contacts", "", gantt),
      RUNS.some((r) => r.keyframes.length) && section("Keyframes", "", sheet, "Click one to see the robot there. Discs and arrows: planned contacts and forces."),
      plots(),
      section("Stances of the plan", "wide", stances),
      section("Verdict", "", verdict),
      section("Events", "", events),
      RUNS.some((r) => r.picture) && section("The person", "", (run) => (run.picture ? el("img", { src: run.picture, alt: "heights of the person's parts over time" }) : el("p", { class: "note" }, "–"))),
      section("How it was made", "made", (run) => el("div", { class: "groups" }, pairs("Options", run.options), pairs("Versions", run.versions), pairs("Seconds by stage", run.timings), pairs("Inputs (SHA-256)", run.inputs)))),
    el("footer", {}, `Written by clamber ${DATA.version}. One file, nothing is fetched.`));
  document.body.classList.toggle("compare", RUNS.length > 1);
  addEventListener("keydown", (e) => {
    if (["INPUT", "SELECT", "BUTTON"].includes(e.target.tagName) && e.target.type !== "range") return;
    const act = { " ": () => play(!state.playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1) }[e.key];
    if (act) { e.preventDefault(); act(); }
  });
  night.addEventListener("change", restyle);
  addEventListener("beforeprint", () => paper(true));
  addEventListener("afterprint", () => paper(false));
  go(0);
}

build();
