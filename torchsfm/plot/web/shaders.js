// What the graphics card runs: points as dots, lines of a width in pixels, photographs as sheets.
const $ = id => document.getElementById(id);
const canvas = $("view");
const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
if (!gl) { $("fail").style.display = "block"; throw new Error("no WebGL 2"); }

function program(vertex, fragment) {
  const p = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(p, shader);
  }
  gl.linkProgram(p);
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(p, i).name;
    uniforms[name] = gl.getUniformLocation(p, name);
  }
  return { p, ...uniforms };
}
const dots = program(`
layout(location=0) in vec3 position; layout(location=1) in vec3 color; layout(location=2) in float track; layout(location=3) in float error; layout(location=4) in float mark;
uniform mat4 view; uniform float size, reference, minTrack, maxError, dimming; uniform int mode; uniform vec4 range; uniform vec3 back;
out vec3 shade;
vec3 turbo(float x) {  // Mikhailov's polynomial for the Turbo colour map
  x = clamp(x, 0., 1.);
  vec4 a = vec4(1., x, x * x, x * x * x); vec2 b = a.zw * a.z;
  return vec3(dot(a, vec4(.13572138, 4.61539260, -42.66032258, 132.13108234)) + dot(b, vec2(-152.94239396, 59.28637943)),
              dot(a, vec4(.09140261, 2.19418839, 4.84296658, -14.18503333)) + dot(b, vec2(4.27729857, 2.82956604)),
              dot(a, vec4(.10667330, 12.64194608, -60.58204836, 110.36276771)) + dot(b, vec2(-89.90310912, 27.34824973)));
}
void main() {
  gl_Position = view * vec4(position, 1.);
  if (track < minTrack || error > maxError) gl_Position = vec4(2., 2., 2., 1.);
  gl_PointSize = clamp(size * clamp(reference / gl_Position.w, .7, 3.), 1., 60.);
  shade = mode == 0 ? color : mode == 1 ? turbo((track - range.x) / (range.y - range.x)) : turbo((error - range.z) / (range.w - range.z));
  if (dimming > 0.) { if (mark > 0.) gl_PointSize *= 1.4; else shade = mix(shade, back, dimming); }
}`, `
in vec3 shade; out vec4 result;
void main() { vec2 c = gl_PointCoord - .5; if (dot(c, c) > .25) discard; result = vec4(shade, 1.); }`);
const strokes = program(`
layout(location=0) in vec3 start; layout(location=1) in vec3 end; layout(location=2) in vec4 color;
uniform mat4 view; uniform vec2 pixels; uniform float width;
out vec4 shade;
void main() {
  vec4 a = view * vec4(start, 1.), b = view * vec4(end, 1.);
  float near = 1e-5 * max(abs(a.w), abs(b.w));
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w)); else if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * pixels; float n = length(along);
  vec2 side = n > 0. ? vec2(-along.y, along.x) / n : vec2(0.);
  vec4 p = gl_VertexID % 2 == 0 ? a : b;
  p.xy += side * (gl_VertexID < 2 ? width : -width) / pixels * p.w;
  gl_Position = a.w < near && b.w < near ? vec4(2., 2., 2., 1.) : p;
  shade = color;
}`, `in vec4 shade; out vec4 result; void main() { result = shade; }`);
const sheets = program(`
layout(location=0) in vec3 position; uniform mat4 view; out vec2 uv;
void main() { gl_Position = view * vec4(position, 1.); uv = vec2(gl_VertexID % 2, gl_VertexID / 2); }`, `
in vec2 uv; uniform sampler2D photo; out vec4 result;
void main() { result = vec4(texture(photo, uv).rgb, 1.); }`);

function attribute(location, array, size, type, normalized = false, divisor = 0) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, array, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(location);
  gl.vertexAttribPointer(location, size, type, normalized, 0, 0);
  gl.vertexAttribDivisor(location, divisor);
  return buffer;
}
