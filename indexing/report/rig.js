"use strict";
// A rig of cameras and the people before it in space, turned with the mouse and played.  No library, no network: all is in the page, in
// the attribute data-rig (see calibration.py).
(() => {
  const STEP = 1000 / 15, LONG_STEP = 1000;  // milliseconds
  const KEYS = "Space plays and pauses, the left and right arrows step (with Shift a second), up and down choose what is seen: the rig, " +
    "or what a camera sees; plus and minus come nearer and go away, Home starts again.";
  const NEVER = -32768;

  // ---- vectors -----------------------------------------------------------------------------------------------------------
  const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const times = (rows, x) => rows.map((row) => dot(row, x));

  // ---- unpacking ---------------------------------------------------------------------------------------------------------
  function places(text, unit, middle) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)), view = new DataView(bytes.buffer);
    return Array.from({ length: bytes.length / 2 }, (_, i) => {
      const code = view.getInt16(2 * i, true);
      return code === NEVER ? NaN : code * unit + middle[i % 3];
    });
  }

  function inks(node) {
    const style = getComputedStyle(node), ink = {};
    for (const [key, name] of [["l", "left"], ["r", "right"], ["m", "muted"], ["ink", "ink"], ["line", "line"], ["accent", "accent"]]) {
      ink[key] = style.getPropertyValue("--" + name).trim();
    }
    ink.font = "600 13px " + style.fontFamily;
    return ink;
  }

  function make(parent, tag, css, text) {
    const node = document.createElement(tag);
    if (css) node.className = css;
    if (text !== undefined) node.textContent = text;
    if (parent) parent.append(node);
    return node;
  }

  class Rig {
    constructor(root) {
      const data = JSON.parse(root.dataset.rig);
      root.removeAttribute("data-rig");
      this.root = root;
      this.data = data;
      this.count = data.people * data.joints;
      this.points = places(data.points, data.unit, data.middle);
      this.times = data.times;
      this.start = this.times[0];
      this.end = Math.max(this.start + 1, this.times[this.times.length - 1]);
      this.time = this.start;
      this.playing = false;
      this.seen = -1;  // the camera through which we look; -1 = from outside
      this.home();
      this.build();
      this.listen();
      this.recolour();
    }

    home() {
      this.turn = this.data.turn;  // radians about the vertical, and above the ground
      this.rise = 0.35;
      this.near = 1;
      this.target = this.data.target.slice();
    }

    build() {
      const root = this.root;
      root.textContent = "";
      root.tabIndex = 0;
      root.setAttribute("role", "group");
      root.setAttribute("aria-label", `Cameras and people in space. ${KEYS}`);
      this.canvas = make(root, "canvas");
      this.canvas.setAttribute("role", "img");
      this.canvas.setAttribute("aria-label", "The rig");
      const bar = make(root, "div", "controls");
      this.toggle = make(bar, "button", "", "Play");
      this.toggle.type = "button";
      this.toggle.addEventListener("click", () => this.play(!this.playing));
      this.speed = make(bar, "select");
      this.speed.setAttribute("aria-label", "Speed");
      for (const [value, name] of [[0.1, "a tenth"], [0.25, "a quarter"], [0.5, "half"], [1, "as it was"], [2, "twice"]]) {
        make(this.speed, "option", "", name).value = value;
      }
      this.speed.value = 1;
      this.through = make(bar, "select");
      this.through.setAttribute("aria-label", "Seen from");
      for (const [i, name] of ["from outside", ...this.data.cameras.map((one) => `as ${one.name} sees`)].entries()) {
        make(this.through, "option", "", name).value = i - 1;
      }
      this.through.addEventListener("change", () => this.look(Number(this.through.value)));
      const again = make(bar, "button", "", "Start view");
      again.type = "button";
      again.addEventListener("click", () => { this.home(); this.look(-1); });
      this.clock = make(bar, "span", "clock");
      this.slider = make(root, "input", "slider");
      this.slider.type = "range";
      this.slider.min = this.start;
      this.slider.max = this.end;
      this.slider.step = "any";
      this.slider.setAttribute("aria-label", "Time");
      this.slider.addEventListener("input", () => { this.play(false); this.seek(Number(this.slider.value)); });
    }

    listen() {
      const canvas = this.canvas;
      const held = new Map();
      canvas.addEventListener("pointerdown", (event) => {
        held.set(event.pointerId, [event.offsetX, event.offsetY]);
        if (canvas.setPointerCapture) canvas.setPointerCapture(event.pointerId);
      });
      const drop = (event) => held.delete(event.pointerId);
      canvas.addEventListener("pointerup", drop);
      canvas.addEventListener("pointercancel", drop);
      canvas.addEventListener("pointermove", (event) => {
        const before = held.get(event.pointerId);
        if (!before) return;
        const by = [event.offsetX - before[0], event.offsetY - before[1]];
        if (held.size > 1) this.pinch(held, event);
        held.set(event.pointerId, [event.offsetX, event.offsetY]);
        if (held.size > 1 || event.shiftKey || event.buttons === 2 || event.buttons === 4) this.pan(by[0] / held.size, by[1] / held.size);
        else this.rotate(by[0], by[1]);
      });
      canvas.addEventListener("contextmenu", (event) => event.preventDefault());
      canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(-0.0012 * event.deltaY)); }, { passive: false });
      this.root.addEventListener("keydown", (event) => this.key(event));
      new ResizeObserver(() => this.draw()).observe(this.root);
      window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.recolour());
    }

    pinch(held, event) {
      const others = [...held].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = (x, y) => Math.hypot(x - others[0][0], y - others[0][1]);
      const [x, y] = held.get(event.pointerId);
      this.zoom(Math.max(0.5, Math.min(2, apart(event.offsetX, event.offsetY) / Math.max(1, apart(x, y)))));
    }

    key(event) {
      if (event.altKey || event.ctrlKey || event.metaKey || event.target.tagName === "SELECT") return;
      const step = event.shiftKey ? LONG_STEP : STEP, cameras = this.data.cameras.length;
      const next = (by) => this.look((this.seen + 1 + by + cameras + 1) % (cameras + 1) - 1);
      const does = {
        " ": () => this.play(!this.playing), ArrowLeft: () => this.step(-step), ArrowRight: () => this.step(step),
        ArrowUp: () => next(-1), ArrowDown: () => next(1), "+": () => this.zoom(1.15), "=": () => this.zoom(1.15),
        "-": () => this.zoom(1 / 1.15), Home: () => { this.home(); this.look(-1); this.step(-Infinity); }, End: () => this.step(Infinity),
      }[event.key];
      if (!does || (event.key === " " && event.target.tagName === "BUTTON")) return;
      event.preventDefault();
      does();
    }

    recolour() { this.ink = inks(this.root); this.draw(); }

    rotate(x, y) {
      this.seen = -1;
      this.turn -= 0.008 * x;
      this.rise = Math.max(-1.5, Math.min(1.5, this.rise + 0.008 * y));
      this.draw();
    }

    pan(x, y) {
      const { right, up } = this.axes();
      const scale = 1 / this.scale();
      this.target = add(add(this.target, right, -x * scale), up, y * scale);
      this.draw();
    }

    zoom(by) {
      this.near = Math.max(0.2, Math.min(30, this.near * by));
      this.draw();
    }

    look(camera) {
      this.seen = camera;
      this.draw();
    }

    seek(time) {
      this.time = Math.min(this.end, Math.max(this.start, time));
      this.draw();
    }

    step(by) {
      this.play(false);
      this.seek(this.time + by);
    }

    play(on) {
      if (on && this.time >= this.end) this.time = this.start;
      if (on && !this.playing) { this.last = null; requestAnimationFrame((now) => this.tick(now)); }
      this.playing = on;
      this.draw();
    }

    tick(now) {
      if (!this.playing) return;
      if (this.last !== null) this.time += Math.min(250, now - this.last) * Number(this.speed.value);
      this.last = now;
      if (this.time >= this.end) { this.time = this.end; this.playing = false; }
      this.draw();
      if (this.playing) requestAnimationFrame((again) => this.tick(again));
    }

    // ---- what is seen ----------------------------------------------------------------------------------------------------
    // joints at this moment, [x, y, z] each, NaN where unknown; between two frames in proportion
    now() {
      const { times, count, points } = this, end = times.length - 1;
      let low = 0, high = end;
      while (high - low > 1) { const middle = (low + high) >> 1; if (times[middle] <= this.time) low = middle; else high = middle; }
      const apart = times[high] - times[low], share = apart > 0 ? Math.min(1, Math.max(0, (this.time - times[low]) / apart)) : 0;
      const near = share < 0.5 ? low : high;
      return Array.from({ length: count }, (_, k) => [0, 1, 2].map((axis) => {
        const at = (frame) => points[3 * (frame * count + k) + axis];
        const between = at(low) + share * (at(high) - at(low));
        return Number.isNaN(between) || apart > this.data.gap ? at(near) : between;
      }));
    }

    axes() {
      const [c, s] = [Math.cos(this.turn), Math.sin(this.turn)], [cr, sr] = [Math.cos(this.rise), Math.sin(this.rise)];
      return { right: [-s, c, 0], up: [-c * sr, -s * sr, cr], back: [c * cr, s * cr, sr] };
    }

    scale() { return this.near * Math.min(this.width, 1.3 * this.height) / (1.8 * this.data.reach); }

    // a function from a point in space to the picture: [x, y, depth], depth <= 0 behind the eye
    projection() {
      const { width, height } = this;
      if (this.seen >= 0) {
        const one = this.data.cameras[this.seen], scale = Math.min(width / one.size[0], height / one.size[1]);
        const left = (width - scale * one.size[0]) / 2, top = (height - scale * one.size[1]) / 2;
        return (point) => {
          const [x, y, z] = add(times(one.R, point), one.t);
          const [u, v] = [x / z, y / z], r2 = u * u + v * v, bent = 1 + one.k[0] * r2 + one.k[1] * r2 * r2;
          return [left + scale * (one.K[0] * u * bent + one.K[2]), top + scale * (one.K[1] * v * bent + one.K[3]), z];
        };
      }
      const { right, up, back } = this.axes(), far = 6 * this.data.reach, scale = this.scale();
      return (point) => {
        const away = add(point, this.target, -1), depth = far - dot(away, back);
        const size = scale * far / depth;
        return [width / 2 + size * dot(away, right), height / 2 - size * dot(away, up), depth];
      };
    }

    line(a, b, colour, wide) {
      const [p, q] = [this.to(a), this.to(b)];
      if (!(p[2] > 1e-6) || !(q[2] > 1e-6)) return;
      const pen = this.pen;
      pen.strokeStyle = colour;
      pen.lineWidth = wide;
      pen.beginPath();
      pen.moveTo(p[0], p[1]);
      pen.lineTo(q[0], q[1]);
      pen.stroke();
    }

    begin() {
      const canvas = this.canvas, ratio = window.devicePixelRatio || 1;
      this.width = Math.max(1, canvas.clientWidth);
      this.height = Math.max(1, canvas.clientHeight);
      const [wide, tall] = [Math.round(this.width * ratio), Math.round(this.height * ratio)];
      if (canvas.width !== wide || canvas.height !== tall) { canvas.width = wide; canvas.height = tall; }
      this.pen = canvas.getContext("2d");
      this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      this.pen.clearRect(0, 0, this.width, this.height);
      this.pen.lineCap = this.pen.lineJoin = "round";
      this.to = this.projection();
    }

    ground() {
      const { data, ink } = this;
      const { from, to, step } = data.ground, z = 0;
      for (let x = from[0]; x <= to[0] + 1e-6; x += step) this.line([x, from[1], z], [x, to[1], z], ink.line, 1);
      for (let y = from[1]; y <= to[1] + 1e-6; y += step) this.line([from[0], y, z], [to[0], y, z], ink.line, 1);
    }

    camera(one, number) {
      const { ink, data } = this, deep = 0.09 * data.reach;
      if (number === this.seen) return;
      const [fx, fy, cx, cy] = one.K, columns = [0, 1, 2].map((j) => one.R.map((row) => row[j]));
      const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => {
        const ray = [(u * one.size[0] - cx) / fx * deep, (v * one.size[1] - cy) / fy * deep, deep];
        return add(one.center, times(columns, ray));
      });
      corners.forEach((corner, i) => {
        this.line(one.center, corner, ink.accent, 1.4);
        this.line(corner, corners[(i + 1) % 4], ink.accent, i === 0 ? 3 : 1.4);  // the thick side is the top of the picture
      });
      this.name(one.name, one.center, ink.accent);
    }

    name(text, point, colour) {
      const at = this.to(point), pen = this.pen;
      if (!(at[2] > 1e-6)) return;
      pen.font = this.ink.font;
      pen.textAlign = "center";
      pen.fillStyle = colour;
      pen.fillText(text, at[0], at[1] - 10);
    }

    person(joints, name) {
      const { data, ink, pen } = this, there = (j) => !Number.isNaN(joints[j][0]);
      let drawn = 0;
      for (const [a, b, side] of data.bones) if (there(a) && there(b)) { this.line(joints[a], joints[b], ink[side], 2.6); drawn += 1; }
      if (!data.bones.length) {
        for (const joint of joints) {
          const at = this.to(joint);
          if (!(at[2] > 1e-6)) continue;
          pen.fillStyle = ink.ink;
          pen.beginPath();
          pen.arc(at[0], at[1], 2.6, 0, 7);
          pen.fill();
          drawn += 1;
        }
      }
      const top = joints.filter((joint) => !Number.isNaN(joint[2])).reduce((a, b) => (a && a[2] > b[2] ? a : b), null);
      if (name && top) this.name(name, top, ink.ink);
      return drawn;
    }

    frame() {
      const one = this.data.cameras[this.seen], scale = Math.min(this.width / one.size[0], this.height / one.size[1]);
      this.pen.strokeStyle = this.ink.line;
      this.pen.lineWidth = 1;
      const [w, h] = [scale * one.size[0], scale * one.size[1]];
      this.pen.strokeRect((this.width - w) / 2, (this.height - h) / 2, w, h);
    }

    draw() {
      if (!this.ink) return;
      const { data } = this;
      this.begin();
      if (this.seen >= 0) this.frame();
      this.ground();
      data.cameras.forEach((one, i) => this.camera(one, i));
      const joints = this.now();
      let seen = 0;
      for (let who = 0; who < data.people; who++) {
        const own = joints.slice(who * data.joints, (who + 1) * data.joints);
        if (this.person(own, data.people > 1 ? String(who + 1) : "")) seen += 1;
      }
      this.clock.textContent = `${(this.time / 1000).toFixed(2)} / ${(this.end / 1000).toFixed(2)} s`;
      this.slider.value = this.time;
      this.through.value = this.seen;
      this.toggle.textContent = this.playing ? "Pause" : "Play";
      this.root.dataset.time = (this.time / 1000).toFixed(3);
      this.root.dataset.people = String(seen);
    }
  }

  for (const root of document.querySelectorAll(".rig")) {
    try {
      new Rig(root);
    } catch (error) {
      root.textContent = `This browser cannot show the scene (${error.message}); all it shows is in the pictures and tables.`;
    }
  }
})();
