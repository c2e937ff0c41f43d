// Draws a run: a small WebGL 2 renderer with one light, soft shadows and an orbit camera.
// Matrices are column-major Float32Arrays of 16; z is up; lengths are metres.

"use strict";

const V = {
  add: (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]],
  sub: (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]],
  scale: (a, s) => [a[0] * s, a[1] * s, a[2] * s],
  dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  unit: (a) => V.scale(a, 1 / (Math.hypot(...a) || 1)),
};

// Columns are three axes (each may be scaled) and an origin.
function frame(x, y, z, p) {
  return new Float32Array([...x, 0, ...y, 0, ...z, 0, ...p, 1]);
}

function product(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

// World to camera, from its unit axes and place.
function viewMatrix(right, up, forward, eye) {
  const back = V.scale(forward, -1), m = [];
  for (let i = 0; i < 3; i++) m.push(right[i], up[i], back[i], 0);
  return new Float32Array([...m, -V.dot(right, eye), -V.dot(up, eye), -V.dot(back, eye), 1]);
}

function perspective(fovy, aspect, near, far) {
  const f = 1 / Math.tan(fovy / 2), d = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) / d, -1, 0, 0, (2 * near * far) / d, 0]);
}

function orthographic(half, near, far) {
  const d = near - far;
  return new Float32Array([1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, 2 / d, 0, 0, 0, (near + far) / d, 1]);
}

function axesOf(azimuth, elevation) {
  const a = (azimuth * Math.PI) / 180, e = (elevation * Math.PI) / 180;
  const forward = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
  const right = [Math.sin(a), -Math.cos(a), 0];
  return { right, up: V.cross(right, forward), forward };
}

// The nearest camera that has all points in the picture; as `frame_view` of viz.py.
function fitted(points, azimuth, elevation, aspect, fovy) {
  const { right, up, forward } = axesOf(azimuth, elevation);
  const half = Math.tan(fovy / 2) * 0.93, place = [];
  let nearest = Infinity;
  for (const [axis, t] of [[right, half * aspect], [up, half]]) {
    let low = -Infinity, high = Infinity;
    for (const p of points) {
      low = Math.max(low, V.dot(p, axis) - t * V.dot(p, forward));
      high = Math.min(high, V.dot(p, axis) + t * V.dot(p, forward));
    }
    place.push((low + high) / 2);
    nearest = Math.min(nearest, (high - low) / (2 * t));
  }
  const depth = points.reduce((sum, p) => sum + V.dot(p, forward), 0) / points.length;
  const eye = V.add(V.add(V.scale(right, place[0]), V.scale(up, place[1])), V.scale(forward, nearest));
  const distance = depth - nearest;
  return { azimuth, elevation, distance, target: V.add(eye, V.scale(forward, distance)) };
}

const VERTEX = `#version 300 es
layout(location=0) in vec3 position; layout(location=1) in vec3 normal; layout(location=2) in vec3 colour;
uniform mat4 model, camera, light; uniform float scale;
out vec3 p, n, c; out vec4 s;
void main() {
  vec4 w = model * vec4(position * scale, 1.0);
  p = w.xyz; n = mat3(model) * normal; c = colour; s = light * w; gl_Position = camera * w;
}`;

// Light from above and from the sky; shadows by comparison with the light's depths;
// near a contact less of the sky is seen, which darkens what the robot stands on.
const FRAGMENT = `#version 300 es
precision highp float; precision highp sampler2DShadow;
in vec3 p, n, c; in vec4 s; out vec4 colour;
uniform sampler2DShadow depths; uniform vec3 eye, sun, sky, earth, tint; uniform vec4 near[12];
uniform float alpha, tinted, ground, reach, flat_, spread; uniform vec3 base, lines; uniform vec2 centre;
const vec2 taps[16] = vec2[16](vec2(-.94,-.4),vec2(.95,-.77),vec2(-.09,-.93),vec2(.34,.29),vec2(-.92,.46),
  vec2(-.82,-.88),vec2(-.38,.28),vec2(.97,.76),vec2(.44,-.98),vec2(.54,-.47),vec2(-.26,-.42),vec2(.79,.19),
  vec2(-.24,1.),vec2(-.81,.91),vec2(.2,.79),vec2(.14,-.14));
float lit(float facing) {
  vec3 q = s.xyz / s.w * 0.5 + 0.5;
  if (q.x < 0.0 || q.x > 1.0 || q.y < 0.0 || q.y > 1.0 || q.z > 1.0) return 1.0;
  float turn = 6.2832 * fract(52.98 * fract(dot(gl_FragCoord.xy, vec2(.0671, .00584)))), sum = 0.0;
  mat2 R = mat2(cos(turn), sin(turn), -sin(turn), cos(turn));
  for (int i = 0; i < 16; i++)
    sum += texture(depths, vec3(q.xy + R * taps[i] * spread, q.z - 0.0008 - 0.0025 * (1.0 - facing)));
  return sum / 16.0;
}
float open() {
  float f = 1.0;
  for (int i = 0; i < 12; i++) {
    vec3 d = p - near[i].xyz; f *= 1.0 - 0.5 * near[i].w * exp(-dot(d, d) / 0.006);
  }
  return f;
}
float grid(vec2 x, float cell, float wide) {
  vec2 g = abs(fract(x / cell - 0.5) - 0.5) * cell, w = fwidth(x);
  vec2 a = (1.0 - smoothstep(vec2(wide * 0.5), wide * 0.5 + w, g)) * min(vec2(1.0), wide / w + 0.35);
  return max(a.x, a.y);
}
void main() {
  vec3 albedo = ground > 0.5 ? base : mix(c * c, tint, tinted), N = normalize(n), E = normalize(eye - p);
  if (flat_ > 0.5) { colour = vec4(sqrt(tint), alpha); return; }
  if (dot(N, E) < 0.0) N = -N;
  float facing = max(dot(N, sun), 0.0), shade = facing > 0.0 ? lit(facing) : 0.0, o = open();
  vec3 ambient = mix(earth, sky, 0.5 + 0.5 * N.z) * o;
  vec3 back = vec3(0.10) * max(dot(N, normalize(vec3(-sun.xy, 0.35))), 0.0);
  vec3 x = albedo * (ambient + back + facing * shade * vec3(1.06, 1.01, 0.93));
  if (ground > 0.5) {
    float far = length(p.xy - centre) / reach;
    x = albedo * mix(0.62, 1.0, shade) * mix(0.45, 1.0, o);
    x = mix(x, lines, 0.35 * grid(p.xy, 0.1, 0.0015) * (1.0 - smoothstep(0.1, 0.5, far)));
    x = mix(x, lines, 0.8 * grid(p.xy, 0.5, 0.003));
    x = mix(x, base, smoothstep(0.25, 0.95, far));
  } else {
    float edge = 1.0 - max(dot(N, E), 0.0);
    vec3 H = normalize(sun + E);
    x += 0.10 * shade * pow(max(dot(N, H), 0.0), 40.0) + sky * 0.10 * pow(edge, 4.0);
    x *= 1.0 - 0.35 * smoothstep(0.72, 1.0, edge) * (1.0 - tinted);
  }
  colour = vec4(sqrt(x), alpha);
}`;

const DEPTH_VERTEX = `#version 300 es
layout(location=0) in vec3 position; uniform mat4 model, light; uniform float scale;
void main() { gl_Position = light * model * vec4(position * scale, 1.0); }`;
const DEPTH_FRAGMENT = `#version 300 es
precision highp float; void main() {}`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    at[name.replace("[0]", "")] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

// Vertices as floats or int16, normals as floats or int8, colours as bytes or none.
function upload(gl, vertices, normals, colours, triangles, mode = gl.TRIANGLES) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  const kinds = { Float32Array: gl.FLOAT, Int16Array: gl.SHORT, Int8Array: gl.BYTE, Uint8Array: gl.UNSIGNED_BYTE };
  [vertices, normals, colours].forEach((data, i) => {
    if (!data) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, 3, kinds[data.constructor.name], i > 0 && !(data instanceof Float32Array), 0, 0);
  });
  const index = new Uint32Array(triangles);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);
  return { array, count: index.length, mode };
}

// A profile of [r, z, nr, nz] turned about z.
function turned(gl, profile, slices = 28) {
  const v = [], n = [], f = [];
  profile.forEach(([r, z, nr, nz], i) => {
    for (let k = 0; k <= slices; k++) {
      const a = (2 * Math.PI * k) / slices, j = i * (slices + 1) + k;
      v.push(r * Math.cos(a), r * Math.sin(a), z);
      n.push(nr * Math.cos(a), nr * Math.sin(a), nz);
      if (i && k) f.push(j, j - 1, j - slices - 1, j - 1, j - slices - 2, j - slices - 1);
    }
  });
  return upload(gl, new Float32Array(v), new Float32Array(n), null, f);
}

// Any axes with the third along `way`.
function along(way, wide, long, p) {
  const z = V.unit(way), x = V.unit(V.cross(Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], z));
  return frame(V.scale(x, wide), V.scale(V.cross(z, x), wide), V.scale(z, long), p);
}

// The renderer of one run on one canvas. `draw(picture)` shows
// {poses: [matrix a mesh], ghost: same or null, discs: [{p, n, colour}], arrows: [{p, f, colour}]}.
function createScene(canvas, meshes, edges, seen, start) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
  if (!gl) return null;
  const look = program(gl, VERTEX, FRAGMENT), dark = program(gl, DEPTH_VERTEX, DEPTH_FRAGMENT);
  const solids = meshes.map((m) => ({ ...upload(gl, m.vertices, m.normals, m.colours, m.triangles), scale: m.scale, body: m.body }));
  const wires = edges.length ? upload(gl, new Float32Array(edges), null, null, edges.filter((_, i) => i % 3 === 0).map((_, i) => i), gl.LINES) : null;
  const plane = upload(gl, new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]), new Float32Array([0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1]), null, [0, 1, 2, 0, 2, 3]);
  const disc = turned(gl, [[0, 0, 0, 1], [0.7, 0, 0, 1]]), ring = turned(gl, [[0.78, 0, 0, 1], [1, 0, 0, 1]]);
  const shaft = turned(gl, [[1, 0, 1, 0], [1, 1, 1, 0]], 14), head = turned(gl, [[0, 1, 0.7, 0.7], [1, 0, 0.7, 0.7], [0, 0, 0, -1]], 20);
  const SIZE = 2048, shadow = gl.createTexture(), target = gl.createFramebuffer();
  gl.bindTexture(gl.TEXTURE_2D, shadow);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SIZE, SIZE);
  for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR], [gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE], [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]])
    gl.texParameteri(gl.TEXTURE_2D, key, value);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, shadow, 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);

  // Shadows reach as far as what stands nearby; a hall around the robot has none.
  const low = [0, 1, 2].map((k) => Math.min(...seen.map((p) => p[k]))), high = [0, 1, 2].map((k) => Math.max(...seen.map((p) => p[k])));
  const middle = V.scale(V.add(low, high), 0.5), radius = 0.5 * Math.hypot(...V.sub(high, low));
  let wide = radius;
  for (const m of meshes) {
    if (m.body > 0) continue;
    for (let i = 0; i < m.vertices.length; i += 3)
      wide = Math.max(wide, Math.hypot(...V.sub([0, 1, 2].map((k) => m.vertices[i + k] * m.scale), middle)));
  }
  wide = Math.min(wide, 3 * radius);
  const sun = V.unit([-0.42 * Math.cos(start) + 0.5 * Math.sin(start), -0.42 * Math.sin(start) - 0.5 * Math.cos(start), 1.15]);
  const lightAxes = (() => { const forward = V.scale(sun, -1), right = V.unit(V.cross(forward, [0, 0, 1])); return [right, V.cross(right, forward), forward]; })();
  const light = product(orthographic(wide * 1.05, 0.1, 8 * wide), viewMatrix(...lightAxes, V.add(middle, V.scale(sun, 4 * wide))));
  const FOVY = 0.6;

  function solid(part, model, to) {
    gl.uniformMatrix4fv(to.at.model, false, model);
    gl.uniform1f(to.at.scale, part.scale || 1);
    gl.bindVertexArray(part.array);
    gl.drawElements(part.mode, part.count, gl.UNSIGNED_INT, 0);
  }

  const UNIT = frame([1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]);
  function draw(picture, camera, theme, width, height) {
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.enable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, SIZE, SIZE);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(dark.made);
    gl.uniformMatrix4fv(dark.at.light, false, light);
    solids.forEach((m, i) => solid(m, picture.poses[i], dark));

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...theme.base.map(Math.sqrt), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { right, up, forward } = axesOf(camera.azimuth, camera.elevation);
    const eye = V.sub(camera.target, V.scale(forward, camera.distance));
    const lens = perspective(FOVY, width / height, camera.distance / 40, camera.distance * 6 + 20);
    const u = look.at;
    gl.useProgram(look.made);
    gl.uniformMatrix4fv(u.camera, false, product(lens, viewMatrix(right, up, forward, eye)));
    gl.uniformMatrix4fv(u.light, false, light);
    for (const [name, x] of Object.entries({ eye, sun, sky: theme.sky, earth: theme.earth, base: theme.base, lines: theme.lines })) gl.uniform3fv(u[name], x);
    const near = new Float32Array(48);
    picture.discs.slice(0, 12).forEach((d, i) => near.set([...d.p, 1], 4 * i));
    gl.uniform4fv(u.near, near);
    gl.uniform2f(u.centre, middle[0], middle[1]);
    gl.uniform1f(u.reach, 4.5 * radius);
    gl.uniform1f(u.spread, 0.004 / wide);
    const mark = (alpha, tinted, tint, ground = 0, flat = 0) => {
      gl.uniform1f(u.alpha, alpha); gl.uniform1f(u.tinted, tinted); gl.uniform3fv(u.tint, tint);
      gl.uniform1f(u.ground, ground); gl.uniform1f(u.flat_, flat);
    };
    const floor = frame([4.6 * radius, 0, 0], [0, 4.6 * radius, 0], [0, 0, 1], [middle[0], middle[1], 0]);
    if (eye[2] > 0) { mark(1, 0, [0, 0, 0], 1); solid(plane, floor, look); }
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1, 1);
    mark(1, 0, [0, 0, 0]);
    solids.forEach((m, i) => solid(m, picture.poses[i], look));
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (wires) { mark(0.55, 1, [0.1, 0.07, 0.04], 0, 1); solid(wires, UNIT, look); }
    if (picture.ghost) {
      const shown = solids.map((m, i) => [m, picture.ghost[i]]).filter(([m]) => m.body > 0);
      mark(0.5, 0.85, theme.ghost);
      gl.colorMask(false, false, false, false);
      shown.forEach(([m, pose]) => solid(m, pose, look));
      gl.colorMask(true, true, true, true);
      gl.depthFunc(gl.LEQUAL);
      shown.forEach(([m, pose]) => solid(m, pose, look));
      gl.depthFunc(gl.LESS);
    }
    // Marks twice: pale where something hides them, then as they are.
    for (const [test, alpha] of [[gl.GREATER, 0.38], [gl.LEQUAL, 0.95]]) {
      gl.depthFunc(test);
      gl.depthMask(test === gl.LEQUAL);
      for (const d of picture.discs) {
        const size = 0.055, lifted = V.add(d.p, V.scale(d.n, 0.004));
        mark(alpha * 0.45, 1, d.colour, 0, 1);
        solid(disc, along(d.n, size, size, lifted), look);
        mark(alpha, 1, d.colour, 0, 1);
        solid(ring, along(d.n, size, size, lifted), look);
      }
      for (const a of picture.arrows) {
        const long = Math.hypot(...a.f), tip = Math.min(0.05, 0.5 * long), way = V.unit(a.f);
        mark(Math.max(alpha, 0.6), 1, a.colour, 0, 1);
        solid(shaft, along(way, 0.0075, long - tip, a.p), look);
        solid(head, along(way, 0.02, tip, V.add(a.p, V.scale(way, long - tip))), look);
      }
      gl.depthMask(true);
    }
    gl.depthFunc(gl.LESS);
    gl.disable(gl.BLEND);
  }

  const fit = (azimuth, elevation, aspect) => fitted(seen, azimuth + (180 / Math.PI) * start, elevation, aspect, FOVY);
  return { draw, fit, radius };
}

// Drag to turn, Shift or right button or two fingers to move, wheel or pinch to zoom.
function orbit(canvas, read, change) {
  const fingers = new Map();
  const moved = (camera, dx, dy) => {
    const { right, up } = axesOf(camera.azimuth, camera.elevation);
    const pixel = (2 * camera.distance * Math.tan(0.3)) / canvas.clientHeight;
    return { ...camera, target: V.add(camera.target, V.add(V.scale(right, -dx * pixel), V.scale(up, dy * pixel))) };
  };
  const zoomed = (camera, factor) => ({ ...camera, distance: Math.min(40, Math.max(0.2, camera.distance * factor)) });
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const last = fingers.get(e.pointerId);
    if (!last) return;
    const before = [...fingers.values()];
    const dx = e.clientX - last[0], dy = e.clientY - last[1];
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    const camera = read();
    if (fingers.size === 2) {
      const after = [...fingers.values()], span = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
      change(zoomed(moved(camera, dx / 2, dy / 2), span(before) / span(after)));
    } else if (e.shiftKey || e.buttons === 2) change(moved(camera, dx, dy));
    else change({ ...camera, azimuth: camera.azimuth - 0.35 * dx, elevation: Math.min(20, Math.max(-89.9, camera.elevation - 0.35 * dy)) });
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); change(zoomed(read(), Math.exp(0.0012 * e.deltaY))); }, { passive: false });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
}
