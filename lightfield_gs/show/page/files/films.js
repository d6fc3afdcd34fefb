// Films on a canvas at the screen's own pixels: frames of the server, quilts that are woven here, pictures of two eyes.

const VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform sampler2D film;
uniform ivec2 size; // of the canvas
out vec4 colour;
ivec2 pixel() { return ivec2(int(gl_FragCoord.x), size.y - 1 - int(gl_FragCoord.y)); }
`;

const COPY = `${HEAD}
void main() { colour = vec4(texelFetch(film, pixel(), 0).rgb, 1.0); }`;

// Twin of lightfield_gs/encoding/weave.py with linear interpolation: two views beside each place, bilinear colours
const WEAVE = `${HEAD}
uniform usampler2D views; // of the sub-pixels
uniform sampler2D places; // of the panel's views among those of the quilt
uniform ivec2 tiles, tile; // columns and rows; width and height in pixels
uniform int filmHeight;
uniform vec4 window; // left, top, width and height of what is seen of a view
vec3 taken(int view, vec2 at) {
  vec2 inside = clamp(at * vec2(tile) - 0.5, vec2(0.0), vec2(tile - 1));
  ivec2 low = ivec2(floor(inside)), high = min(low + 1, tile - 1);
  ivec2 corner = ivec2((view % tiles.x) * tile.x, filmHeight - (view / tiles.x + 1) * tile.y);
  vec2 part = inside - vec2(low);
  vec3 above = mix(texelFetch(film, corner + low, 0).rgb, texelFetch(film, corner + ivec2(high.x, low.y), 0).rgb, part.x);
  vec3 below = mix(texelFetch(film, corner + ivec2(low.x, high.y), 0).rgb, texelFetch(film, corner + high, 0).rgb, part.x);
  return mix(above, below, part.y);
}
void main() {
  vec2 at = window.xy + (vec2(pixel()) + 0.5) / vec2(size) * window.zw;
  uvec3 seen = texelFetch(views, pixel(), 0).rgb;
  vec3 mixed = vec3(0.0);
  colour = vec4(mixed, 1.0);
  if (any(lessThan(at, vec2(-1e-5))) || any(greaterThan(at, vec2(1.00001)))) return;
  for (int channel = 0; channel < 3; channel++) {
    float place = texelFetch(places, ivec2(int(seen[channel]) % 4096, int(seen[channel]) / 4096), 0).r;
    int low = int(floor(place)), last = tiles.x * tiles.y - 1;
    mixed[channel] = mix(taken(low, at)[channel], taken(min(low + 1, last), at)[channel], place - float(low));
  }
  colour = vec4(mixed, 1.0);
}`;

// Both eyes' pictures from one arrangement to another; anaglyphs as lightfield_gs/encoding/stereo.py makes them
const EYES = `${HEAD}
uniform int from, to; // 0: side by side, 1: one above the other; 2: an anaglyph
uniform bool swapped;
vec3 eye(int which, vec2 at) {
  float half_ = float(swapped ? 1 - which : which);
  vec2 texel = 0.5 / vec2(textureSize(film, 0));
  vec2 place = from == 0 ? vec2((at.x + half_) / 2.0, at.y) : vec2(at.x, (at.y + half_) / 2.0);
  vec2 low = (from == 0 ? vec2(half_ / 2.0, 0.0) : vec2(0.0, half_ / 2.0)) + texel;
  vec2 high = (from == 0 ? vec2(half_ / 2.0 + 0.5, 1.0) : vec2(1.0, half_ / 2.0 + 0.5)) - texel;
  return texture(film, clamp(place, low, high)).rgb;
}
vec3 light(vec3 c) { return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c)); }
vec3 code(vec3 c) { return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
const mat3 LEFT = mat3(0.4561, -0.0400822, -0.0152161, 0.500484, -0.0378246, -0.0205971, 0.176381, -0.0157589, -0.00546856);
const mat3 RIGHT = mat3(-0.0434706, 0.378476, -0.0721527, -0.0879388, 0.73364, -0.112961, -0.00155529, -0.0184503, 1.2264);
void main() {
  vec2 at = (vec2(pixel()) + 0.5) / vec2(size);
  if (to == 2) {
    colour = vec4(code(clamp(LEFT * light(eye(0, at)) + RIGHT * light(eye(1, at)), 0.0, 1.0)), 1.0);
    return;
  }
  float along = to == 0 ? at.x : at.y;
  int which = along < 0.5 ? 0 : 1;
  float own = along * 2.0 - float(which);
  colour = vec4(eye(which, to == 0 ? vec2(own, at.y) : vec2(at.x, own)), 1.0);
}`;

/** A canvas that shows the pixels of films. */
class Screen {
  constructor(width, height, fragment) {
    this.canvas = Object.assign(document.createElement("canvas"), { width, height });
    const gl = this.gl = this.canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2, which films need: switch its hardware acceleration on.");
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (Math.max(width, height) > most) throw new Error(`This browser draws at most ${most} pixels a side.`);
    const program = this.program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`Films cannot be drawn here: ${gl.getShaderInfoLog(shader)}`);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`Films cannot be drawn here: ${gl.getProgramInfoLog(program)}`);
    gl.useProgram(program);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    this.set("size", "2i", width, height);
    this.texture(0, "film", gl.LINEAR);
  }

  set(name, kind, ...values) {
    this.gl[`uniform${kind}`](this.gl.getUniformLocation(this.program, name), ...values);
  }

  texture(unit, name, filter) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, filter);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    this.set(name, "1i", unit);
  }

  /** Shows a frame: an element, or bytes of RGB of the canvas's size. */
  draw(frame) {
    const { gl, canvas } = this;
    gl.activeTexture(gl.TEXTURE0);
    if (frame instanceof Uint8Array)
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, canvas.width, canvas.height, 0, gl.RGB, gl.UNSIGNED_BYTE, frame);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, frame);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

/** A film: `element` shows it; play() and stop(); `ended` is called at its end, `failed` with words where it cannot. */
export function openFilm(slide, index, panel, loops, ended, failed) {
  const open = { frames: openFrames, quilt: openVideo, eyes: openVideo }[slide.kind];
  return open(slide, index, panel, loops, ended, failed);
}

// Frames of the server, one after the other

async function openFrames(slide, index, panel, loops, ended, failed) {
  const screen = new Screen(panel.width_px, panel.height_px, COPY);
  const who = crypto.randomUUID?.() ?? String(Math.random());
  let at = 0, isPlaying = false, isOver = false, due = 0, coming = ask(0);

  async function ask(number) {
    const answer = await fetch(`frame.rgb?n=${index}&at=${number}&who=${who}`);
    if (!answer.ok) throw new Error(await answer.text());
    return new Uint8Array(await answer.arrayBuffer());
  }

  async function run() {
    try {
      while (isPlaying && !isOver) {
        const frame = await coming;
        if (!isPlaying || isOver) return;
        if (frame.length === 0) {
          if (at === 0) throw new Error(`${slide.name} has no frames.`);
          if (!loops) { isPlaying = false; ended(); return; }
          at = 0;
          coming = ask(0);
          continue;
        }
        const wait = due - performance.now();
        if (wait > 1) await new Promise((done) => setTimeout(done, wait));
        if (!isPlaying || isOver) return; // the frame stays the next one
        screen.draw(frame);
        screen.canvas.dataset.frame = at;
        due = Math.max(due, performance.now() - 100) + 1000 / slide.fps; // where frames come late, it is slower
        coming = ask(++at);
      }
    } catch (error) {
      if (!isOver) failed(error.message);
    }
  }

  screen.draw(await coming);
  return {
    element: screen.canvas,
    play() { if (!isPlaying) { isPlaying = true; due = performance.now(); run(); } },
    stop() { isPlaying = false; },
    close() { isPlaying = false; isOver = true; },
  };
}

// Films that the browser plays: quilts and pictures of two eyes

async function openVideo(slide, index, panel, loops, ended, failed) {
  const video = Object.assign(document.createElement("video"), { muted: true, playsInline: true, preload: "auto", loop: loops });
  const words = `This browser cannot play ${slide.name}. Save it as H.264 (.mp4) or VP9 (.webm).`;
  await new Promise((done, fail) => {
    video.onloadeddata = done;
    video.onerror = () => fail(new Error(words));
    video.src = `film?n=${index}`;
  });
  video.onerror = () => failed(words);
  video.onended = ended;
  const screen = slide.kind === "quilt" ? await weaving(slide, panel, video) : forEyes(slide, video);
  let isOver = false;
  const next = video.requestVideoFrameCallback ? (draw) => video.requestVideoFrameCallback(draw) : requestAnimationFrame;
  const draw = () => {
    if (isOver) return;
    screen.draw(video);
    screen.canvas.dataset.time = video.currentTime;
    next(draw);
  };
  draw();
  return {
    element: screen.canvas,
    play() { video.play().catch(() => failed(words)); },
    stop() { video.pause(); },
    close() { isOver = true; video.pause(); video.removeAttribute("src"); video.load(); },
  };
}

async function weaving(slide, panel, video) {
  const screen = new Screen(panel.width_px, panel.height_px, WEAVE), { gl } = screen, { columns, rows } = slide;
  const bytes = new Uint8Array(await (await fetch("view_map.bin")).arrayBuffer());
  screen.texture(1, "views", gl.NEAREST);
  const isWide = bytes.length > 3 * panel.width_px * panel.height_px;
  const [format, type] = isWide ? [gl.RGB16UI, gl.UNSIGNED_SHORT] : [gl.RGB8UI, gl.UNSIGNED_BYTE];
  const numbers = isWide ? new Uint16Array(bytes.buffer) : bytes;
  gl.texImage2D(gl.TEXTURE_2D, 0, format, panel.width_px, panel.height_px, 0, gl.RGB_INTEGER, type, numbers);
  screen.texture(2, "places", gl.NEAREST);
  const down = Math.ceil(slide.places.length / 4096), across = Math.min(4096, slide.places.length);
  const places = new Float32Array(down * across);
  places.set(slide.places);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, across, down, 0, gl.RED, gl.FLOAT, places);
  screen.set("tiles", "2i", columns, rows);
  screen.set("tile", "2i", Math.floor(video.videoWidth / columns), Math.floor(video.videoHeight / rows));
  screen.set("filmHeight", "1i", video.videoHeight);
  screen.set("window", "4f", ...slide.window);
  return screen;
}

function forEyes(slide, video) {
  const kinds = { sbs: 0, "half-sbs": 0, tab: 1, anaglyph: 2 };
  const screen = new Screen(video.videoWidth, video.videoHeight, EYES);
  screen.set("from", "1i", kinds[slide.from]);
  screen.set("to", "1i", kinds[slide.to]);
  screen.set("swapped", "1i", slide.swapped);
  return screen;
}
