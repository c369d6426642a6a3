// Turns scenes of splats in the page itself: every <canvas class="splats"> has its splats (the 32 bytes each of a .splat
// file, base64), and its cameras and points (JSON), in the elements that its data-splats and data-cameras name. z is up.
"use strict";
(() => {
  const VERTEX = `#version 300 es
    precision highp float; precision highp sampler2D;
    uniform sampler2D data; uniform mat4 view; uniform vec2 focal, size;
    in vec2 corner; in uint index;
    out vec2 place; out vec4 tint;
    void main() {
      ivec2 at = ivec2(int(index % 1024u) * 3, int(index / 1024u));
      vec4 a = texelFetch(data, at, 0), b = texelFetch(data, at + ivec2(1, 0), 0), c = texelFetch(data, at + ivec2(2, 0), 0);
      vec3 p = (view * vec4(a.xyz, 1.0)).xyz;
      gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
      if (p.z < 0.02) return;
      mat3 covariance = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
      vec2 slope = clamp(p.xy / p.z, -1.5, 1.5);
      mat3 J = mat3(focal.x / p.z, 0.0, 0.0, 0.0, focal.y / p.z, 0.0, -focal.x * slope.x / p.z, -focal.y * slope.y / p.z, 0.0);
      mat3 T = J * mat3(view);
      mat3 image = T * covariance * transpose(T);
      float xx = image[0][0] + 0.3, xy = image[0][1], yy = image[1][1] + 0.3;
      float middle = 0.5 * (xx + yy), spread = sqrt(max(0.25 * (xx - yy) * (xx - yy) + xy * xy, 1e-9));
      float large = middle + spread, small = max(middle - spread, 0.1);
      vec2 axis = abs(xy) > 1e-6 ? normalize(vec2(xy, large - xx)) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
      vec2 one = min(sqrt(2.0 * large), 2048.0) * axis, two = min(sqrt(2.0 * small), 2048.0) * vec2(-axis.y, axis.x);
      vec2 pixel = focal * p.xy / p.z + corner.x * one + corner.y * two;
      tint = vec4(floor(c.z / 65536.0), mod(floor(c.z / 256.0), 256.0), mod(c.z, 256.0), c.w) / 255.0;
      // What the blur adds in area it takes in opacity.
      float sharp = max((image[0][0] * image[1][1] - xy * xy) / (xx * yy - xy * xy), 2.5e-5);
      tint.a *= sqrt(sharp);
      place = corner;
      gl_Position = vec4(2.0 * pixel / size * vec2(1.0, -1.0), 0.0, 1.0);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec2 place; in vec4 tint; out vec4 colour;
    void main() {
      float alpha = tint.a * exp(-dot(place, place));
      if (alpha < 1.0 / 255.0) discard;
      colour = vec4(tint.rgb * alpha, alpha);
    }`;
  const LINE_VERTEX = `#version 300 es
    precision highp float;
    uniform mat4 view; uniform vec2 focal, size; in vec3 point; in vec3 shade; out vec3 tint;
    void main() {
      vec3 p = (view * vec4(point, 1.0)).xyz;
      tint = shade;
      gl_PointSize = 3.0;
      gl_Position = vec4(2.0 * focal * p.xy / size * vec2(1.0, -1.0), 0.0, p.z);
    }`;
  const LINE_FRAGMENT = `#version 300 es
    precision highp float; in vec3 tint; out vec4 colour; void main() { colour = vec4(tint, 1.0); }`;

  const bytesOf = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0));

  function program(gl, vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return made;
  }

  // Means, colours and covariances as a texture of 1,024 splats a row, three texels each.
  function texels(raw) {
    const count = raw.length / 32, rows = Math.max(1, Math.ceil(count / 1024));
    const out = new Float32Array(rows * 1024 * 12), floats = new Float32Array(raw.buffer);
    for (let i = 0; i < count; ++i) {
      const [w, x, y, z] = [0, 1, 2, 3].map(j => (raw[32 * i + 28 + j] - 128) / 128);
      const n = Math.hypot(w, x, y, z) || 1, [a, b, c, d] = [w / n, x / n, y / n, z / n];
      const R = [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c),
                 2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b),
                 2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)];
      const s = [0, 1, 2].map(j => floats[8 * i + 3 + j] ** 2), at = 12 * i;
      const cov = (p, q) => s[0] * R[3 * p] * R[3 * q] + s[1] * R[3 * p + 1] * R[3 * q + 1] + s[2] * R[3 * p + 2] * R[3 * q + 2];
      out.set(floats.subarray(8 * i, 8 * i + 3), at);
      const [red, green, blue, alpha] = raw.subarray(32 * i + 24, 32 * i + 28);
      const colour = 65536 * red + 256 * green + blue;  // whole numbers up to 2^24 are exact
      out.set([cov(0, 0), cov(0, 1), cov(0, 2), cov(1, 1), cov(1, 2), cov(2, 2), colour, alpha], at + 4);
    }
    return {count, rows, out, floats};
  }

  // Pyramids from the cameras' centres to a little before them: pairs of points, and their colours.
  function frusta(cameras, reach) {
    const points = [], shades = [];
    for (const {pose, slopes: [l, r, t, b], colour} of cameras) {
      const put = (x, y, z) => [0, 1, 2].map(i => pose[i][3] + reach * (pose[i][0] * x + pose[i][1] * y + pose[i][2] * z));
      const eye = put(0, 0, 0), corners = [put(l, t, 1), put(r, t, 1), put(r, b, 1), put(l, b, 1)];
      corners.forEach((corner, i) => {
        points.push(...eye, ...corner, ...corner, ...corners[(i + 1) % 4]);
        for (let j = 0; j < 4; ++j) shades.push(...colour);
      });
    }
    return [points, shades];
  }

  class Scene {
    constructor(canvas) {
      this.canvas = canvas;
      const gl = this.gl = canvas.getContext("webgl2", {antialias: false, alpha: false, preserveDrawingBuffer: true});
      if (!gl) throw new Error("This browser has no WebGL 2.");
      const splats = texels(bytesOf(document.getElementById(canvas.dataset.splats).textContent.trim()));
      Object.assign(this, splats);
      const drawn = JSON.parse(document.getElementById(canvas.dataset.cameras).textContent);
      this.cameras = drawn.cameras;
      this.drawing = program(gl, VERTEX, FRAGMENT);
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3072, this.rows, 0, gl.RGBA, gl.FLOAT, this.out);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
      this.corners = this.buffer(new Float32Array([-2, -2, 2, -2, 2, 2, -2, 2]));
      this.order = gl.createBuffer();
      this.lines = program(gl, LINE_VERTEX, LINE_FRAGMENT);
      // Ends of lines first, then single points.
      const [ends, shades] = frusta(this.cameras, 0.12), dots = drawn.points.flat();
      [this.ends, this.dots] = [ends.length / 3, dots.length / 3];
      this.points = this.buffer(new Float32Array([...ends, ...dots]));
      this.shades = this.buffer(new Float32Array([...shades, ...dots.fill(0.9)]));
      [this.frusta, this.cloud] = [true, false];
      this.home();
      this.listen();
    }

    buffer(values) {
      const made = this.gl.createBuffer();
      this.gl.bindBuffer(this.gl.ARRAY_BUFFER, made);
      this.gl.bufferData(this.gl.ARRAY_BUFFER, values, this.gl.STATIC_DRAW);
      return made;
    }

    attribute(made, name, buffer, size, divisor, whole) {
      const gl = this.gl, at = gl.getAttribLocation(made, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(at);
      if (whole) gl.vertexAttribIPointer(at, size, gl.UNSIGNED_INT, 0, 0);
      else gl.vertexAttribPointer(at, size, gl.FLOAT, false, 0, 0);
      gl.vertexAttribDivisor(at, divisor);
    }

    // Look round the origin, from where the first camera is.
    home() {
      const first = this.cameras[0], eye = first ? [0, 1, 2].map(i => first.pose[i][3]) : [0, -1.5, 0.5];
      this.target = [0, 0, 0];
      this.distance = Math.hypot(...eye) || 1;
      this.turn = Math.atan2(eye[1], eye[0]);
      this.tilt = Math.asin(Math.min(1, Math.max(-1, eye[2] / this.distance)));
      this.slope = first ? Math.max(first.slopes[3], -first.slopes[2]) : 0.5;
      this.pose = null;
      this.redraw();
    }

    // Stand exactly at a camera: pose 4 x 4 (x right, y down, z forward), and half of the height at distance 1.
    look(pose, slope) {
      this.pose = pose;
      this.slope = slope;
      this.redraw();
    }

    orbit() {
      const [ct, st, cp, sp] = [Math.cos(this.turn), Math.sin(this.turn), Math.cos(this.tilt), Math.sin(this.tilt)];
      const out = [cp * ct, cp * st, sp], right = [-st, ct, 0], down = [sp * ct, sp * st, -cp];
      return [0, 1, 2].map(i => [right[i], down[i], -out[i], this.target[i] + this.distance * out[i]]);
    }

    listen() {
      let held = null;  // where the pointer was last, and whether it shifts the scene instead of turning it
      const canvas = this.canvas;
      canvas.addEventListener("pointerdown", event => {
        held = {x: event.clientX, y: event.clientY, shift: event.shiftKey || event.button === 2};
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener("pointerup", () => { held = null; });
      canvas.addEventListener("pointermove", event => {
        if (!held) return;
        const [x, y] = [(event.clientX - held.x) / canvas.clientHeight, (event.clientY - held.y) / canvas.clientHeight];
        this.pose = null;
        if (held.shift) {
          const axes = this.orbit(), reach = 2 * this.slope * this.distance;
          for (let i = 0; i < 3; ++i) this.target[i] -= reach * (x * axes[i][0] + y * axes[i][1]);
        } else {
          this.turn -= 4 * x;
          this.tilt = Math.min(1.5, Math.max(-1.5, this.tilt + 4 * y));
        }
        [held.x, held.y] = [event.clientX, event.clientY];
        this.redraw();
      });
      canvas.addEventListener("contextmenu", event => event.preventDefault());
      canvas.addEventListener("dblclick", () => this.home());
      canvas.addEventListener("wheel", event => {
        event.preventDefault();
        this.pose = null;
        this.distance = Math.min(20, Math.max(0.05, this.distance * Math.exp(event.deltaY / 600)));
        this.redraw();
      }, {passive: false});
      canvas.addEventListener("keydown", event => {
        if (event.key === "c") { this.frusta = !this.frusta; this.redraw(); }
        if (event.key === "p") { this.cloud = !this.cloud; this.redraw(); }
      });
    }

    redraw() {
      cancelAnimationFrame(this.waiting);
      this.waiting = requestAnimationFrame(() => this.draw());
    }

    draw() {
      const {gl, canvas} = this, pose = this.pose || this.orbit();
      const [width, height] = [canvas.clientWidth * devicePixelRatio, canvas.clientHeight * devicePixelRatio].map(Math.round);
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      gl.viewport(0, 0, width, height);
      const shift = [0, 1, 2].map(j => -(pose[0][j] * pose[0][3] + pose[1][j] * pose[1][3] + pose[2][j] * pose[2][3]));
      const view = new Float32Array(16);
      for (let j = 0; j < 3; ++j) {
        for (let i = 0; i < 3; ++i) view[4 * i + j] = pose[i][j];
        view[12 + j] = shift[j];
      }
      view[15] = 1;
      this.sort(view);
      const focal = height / (2 * this.slope);
      gl.clearColor(0.5, 0.5, 0.5, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      const settings = made => {
        gl.useProgram(made);
        gl.uniformMatrix4fv(gl.getUniformLocation(made, "view"), false, view);
        gl.uniform2f(gl.getUniformLocation(made, "focal"), focal, focal);
        gl.uniform2f(gl.getUniformLocation(made, "size"), width, height);
      };
      settings(this.drawing);
      this.attribute(this.drawing, "corner", this.corners, 2, 0);
      this.attribute(this.drawing, "index", this.order, 1, 1, true);
      gl.drawArraysInstanced(gl.TRIANGLE_FAN, 0, 4, this.count);
      if (this.pose) return;
      settings(this.lines);
      this.attribute(this.lines, "point", this.points, 3, 0);
      this.attribute(this.lines, "shade", this.shades, 3, 0);
      if (this.frusta) gl.drawArrays(gl.LINES, 0, this.ends);
      if (this.cloud) gl.drawArrays(gl.POINTS, this.ends, this.dots);
    }

    // Farthest first: by counting, over 65,536 depths.
    sort(view) {
      const {gl, count, floats} = this, depth = new Float32Array(count);
      let near = Infinity, far = -Infinity;
      for (let i = 0; i < count; ++i) {
        const d = view[2] * floats[8 * i] + view[6] * floats[8 * i + 1] + view[10] * floats[8 * i + 2];
        depth[i] = d;
        near = Math.min(near, d);
        far = Math.max(far, d);
      }
      const scale = 65535 / Math.max(far - near, 1e-9), begins = new Uint32Array(65537), keys = new Uint16Array(count);
      for (let i = 0; i < count; ++i) {
        keys[i] = (far - depth[i]) * scale;
        ++begins[keys[i] + 1];
      }
      for (let i = 0; i < 65536; ++i) begins[i + 1] += begins[i];
      const order = new Uint32Array(count);
      for (let i = 0; i < count; ++i) order[begins[keys[i]]++] = i;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
      gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    }

    end() {
      cancelAnimationFrame(this.waiting);
      this.gl.getExtension("WEBGL_lose_context")?.loseContext();
    }
  }

  // Browsers allow some sixteen drawings at once: only what is in sight has one.
  const seen = new IntersectionObserver(entries => {
    for (const {target, isIntersecting} of entries) {
      if (isIntersecting && !target.scene) {
        try {
          target.scene = new Scene(target);
        } catch (error) {
          target.replaceWith(Object.assign(document.createElement("p"), {textContent: `The scene cannot be drawn here: ${error.message}`}));
        }
      } else if (!isIntersecting && target.scene) {
        target.scene.end();
        const fresh = target.cloneNode();
        target.replaceWith(fresh);
        seen.observe(fresh);
      }
    }
  });
  document.querySelectorAll("canvas.splats").forEach(canvas => seen.observe(canvas));
})();
