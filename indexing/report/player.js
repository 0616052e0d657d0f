"use strict";
// The player of a recording.  No library, no network: everything is in the page, in the attribute data-player (see player.py).
(() => {
  const FOUND = 0, KNOWN = 1, HELD = 2;
  const ROWS = ["found", "known", "held back"];
  const KEYS = "Space plays and pauses, the left and right arrows step (with Shift a second), up and down go to the action before " +
    "and after, Escape ends a repetition.";
  const LEAST_BAR = 5, ROOMY = 12, WIDEST = 24000;  // pixels: of a bar, of a second of the strip, of the strip
  const STEP = 1000 / 15, LONG_STEP = 1000;  // milliseconds
  const NEVER = -2147483648;

  // ---- unpacking ---------------------------------------------------------------------------------------------------------
  function numbers(text) {
    const bytes = atob(text), out = [];
    let value = 0, scale = 1;
    for (let i = 0; i < bytes.length; i++) {
      const byte = bytes.charCodeAt(i);
      value += (byte & 127) * scale;  // times may need more than 32 bits
      if (byte & 128) scale *= 128;
      else { out.push(value); value = 0; scale = 1; }
    }
    return out;
  }

  function places(text, columns) {
    const codes = numbers(text), out = new Int32Array(codes.length), last = new Int32Array(columns);
    for (let i = 0; i < codes.length; i++) {
      const code = codes[i], column = i % columns;
      if (code === 0) { out[i] = NEVER; continue; }
      last[column] += code % 2 ? (code - 1) / 2 : -code / 2;
      out[i] = last[column];
    }
    return out;
  }

  class Track {
    constructor(found, times) {
      this.name = found.name || "";
      this.skeleton = found.skeleton;
      this.columns = 2 * found.skeleton.joints;
      this.joints = places(found.joints, this.columns);
      this.times = times || [found.first];
      if (!times) for (const step of numbers(found.times)) this.times.push(this.times[this.times.length - 1] + step);
    }

    // [x, y, x, y...] at a moment, NaN where unknown; null where nobody is there
    at(time, absent) {
      const times = this.times, end = times.length - 1;
      if (time < times[0] - absent / 4 || time > times[end] + absent / 4) return null;
      let low = 0, high = end;
      while (high - low > 1) { const middle = (low + high) >> 1; if (times[middle] <= time) low = middle; else high = middle; }
      const apart = times[high] - times[low];
      if (apart > absent && time > times[low] + absent / 4 && time < times[high] - absent / 4) return null;
      const share = apart > 0 ? Math.min(1, Math.max(0, (time - times[low]) / apart)) : 0;
      const out = new Float64Array(this.columns);
      for (let k = 0; k < this.columns; k++) {
        const a = this.joints[low * this.columns + k], b = this.joints[high * this.columns + k];
        if (a !== NEVER && b !== NEVER && apart <= absent) out[k] = a + share * (b - a);
        else out[k] = a === NEVER && b === NEVER ? NaN : (b === NEVER || (a !== NEVER && share < 0.5)) ? a : b;
      }
      return out;
    }
  }

  function bounds(poses) {
    let box = null;
    for (const pose of poses) {
      for (let k = 0; pose && k < pose.length; k += 2) {
        const x = pose[k], y = pose[k + 1];
        if (Number.isNaN(x) || Number.isNaN(y)) continue;
        if (!box) box = [x, y, x, y];
        box = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
      }
    }
    return box;
  }

  // ---- drawing -----------------------------------------------------------------------------------------------------------
  function inks(node) {
    const style = getComputedStyle(node);
    const ink = {};
    for (const [key, name] of [["l", "left"], ["r", "right"], ["m", "muted"], ["ink", "ink"]]) {
      ink[key] = style.getPropertyValue("--" + name).trim();
    }
    ink.font = "600 13px " + style.fontFamily;
    return ink;
  }

  class Stage {
    constructor(canvas, view) { this.canvas = canvas; this.view = view; }

    begin(middle) {
      const canvas = this.canvas, ratio = window.devicePixelRatio || 1;
      const width = Math.max(1, canvas.clientWidth), height = Math.max(1, canvas.clientHeight);
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
      }
      this.pen = canvas.getContext("2d");
      this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      this.pen.clearRect(0, 0, width, height);
      this.pen.lineCap = this.pen.lineJoin = "round";
      this.scale = Math.max(1e-3, Math.min((width - 24) / this.view[0], (height - 44) / this.view[1]));
      this.x = (x) => width / 2 + (x - middle[0]) * this.scale;
      this.y = (y) => height / 2 + 8 - (y - middle[1]) * this.scale;
      this.width = width;
    }

    figure(pose, skeleton, ink, name) {
      const pen = this.pen, there = (j) => !Number.isNaN(pose[2 * j]) && !Number.isNaN(pose[2 * j + 1]);
      const box = bounds([pose]);
      if (!box) return;
      pen.lineWidth = Math.min(4, Math.max(1.6, this.scale * (box[3] - box[1]) / 60));
      for (const [a, b, side] of skeleton.bones) {
        if (!there(a) || !there(b)) continue;
        pen.strokeStyle = ink[side];
        pen.beginPath();
        pen.moveTo(this.x(pose[2 * a]), this.y(pose[2 * a + 1]));
        pen.lineTo(this.x(pose[2 * b]), this.y(pose[2 * b + 1]));
        pen.stroke();
      }
      this.head(pose, skeleton.face.filter(there), box, ink);
      if (!skeleton.bones.length) {
        pen.fillStyle = ink.ink;
        for (let j = 0; j < skeleton.joints; j++) {
          if (!there(j)) continue;
          pen.beginPath();
          pen.arc(this.x(pose[2 * j]), this.y(pose[2 * j + 1]), 2.4, 0, 7);
          pen.fill();
        }
      }
      if (name) this.tag(name, (box[0] + box[2]) / 2, box[3], ink);
    }

    head(pose, face, box, ink) {
      if (!face.length) return;
      const xs = face.map((j) => pose[2 * j]), ys = face.map((j) => pose[2 * j + 1]);
      const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;
      const spread = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys)) / 2;
      const size = 240, radius = Math.min(0.07 * size, Math.max(0.045 * size, spread));  // of a person's height: see player.py
      this.pen.strokeStyle = ink.ink;
      this.pen.beginPath();
      this.pen.arc(this.x(mean(xs)), this.y(mean(ys)), radius * this.scale, 0, 7);
      this.pen.stroke();
    }

    tag(name, x, top, ink) {
      const pen = this.pen;
      pen.font = ink.font;
      pen.textAlign = "center";
      pen.fillStyle = ink.ink;
      const half = Math.min(pen.measureText(name).width, this.width - 8) / 2;
      const at = Math.min(this.width - half - 4, Math.max(half + 4, this.x(x)));
      pen.fillText(name, at, Math.max(14, this.y(top + 14) - 8), this.width - 8);
    }
  }

  // ---- the page's elements -----------------------------------------------------------------------------------------------
  function make(parent, tag, css, text) {
    const node = document.createElement(tag);
    if (css) node.className = css;
    if (text !== undefined) node.textContent = text;
    if (parent) parent.append(node);
    return node;
  }

  const clock = (time) => (time / 1000).toFixed(2) + " s";

  class Player {
    constructor(root) {
      const data = JSON.parse(root.dataset.player);
      root.removeAttribute("data-player");
      this.root = root;
      this.actions = data.actions;
      this.absent = data.absent;
      this.people = data.people.map((one) => new Track(one));
      this.view = data.view;
      this.examples = {};
      for (const [number, one] of Object.entries(data.examples)) {
        const count = places(one.joints, 2 * one.skeleton.joints).length / (2 * one.skeleton.joints);
        const times = Array.from({ length: count }, (_, i) => (i + 0.5) / count);
        this.examples[number] = { track: new Track(one, times), view: one.view, lasts: one.lasts };
      }
      this.bars = data.bars.map(([person, kind, action, start, end, example]) => ({ person, kind, action, start, end, example }));
      const ends = [...this.people.flatMap((one) => [one.times[0], one.times[one.times.length - 1]]),
        ...this.bars.flatMap((bar) => [bar.start, bar.end])];
      this.start = ends.reduce((a, b) => Math.min(a, b));
      this.end = Math.max(this.start + 1, ends.reduce((a, b) => Math.max(a, b)));
      this.time = this.start;
      this.playing = false;
      this.chosen = -1;
      this.build();
      this.strip();
      this.listen();
      this.recolour();
    }

    title(bar) {
      const name = this.people[bar.person].name;
      const who = name ? ", person " + name : "";
      return `${ROWS[bar.kind]}: ${this.actions[bar.action][0]}${who}, ${(bar.start / 1000).toFixed(2)} to ${clock(bar.end)}`;
    }

    build() {
      const root = this.root;
      root.textContent = "";
      root.tabIndex = 0;
      root.setAttribute("role", "group");
      root.setAttribute("aria-label", `Player of ${root.dataset.name}. ${KEYS}`);
      const stages = make(root, "div", "stages");
      const left = make(stages, "figure", "scene"), right = make(stages, "figure", "example");
      this.scene = new Stage(make(left, "canvas"), this.view);
      this.side = new Stage(make(right, "canvas"), [1, 1, 0]);
      this.says = make(left, "figcaption");
      this.shows = make(right, "figcaption");
      this.scene.canvas.setAttribute("role", "img");
      this.side.canvas.setAttribute("role", "img");
      this.scene.canvas.setAttribute("aria-label", "Everybody in view as stick figures");
      const bar = make(root, "div", "controls");
      this.button(bar, "Previous", "Action before (arrow up)", () => this.jump(-1));
      this.toggle = this.button(bar, "Play", "Play or pause (space)", () => this.play(!this.playing));
      this.button(bar, "Next", "Action after (arrow down)", () => this.jump(1));
      this.again = this.button(bar, "Repeat", "Play the chosen action again and again (Escape ends it)", () => this.choose(-1));
      const speed = make(bar, "select");
      speed.setAttribute("aria-label", "Speed");
      for (const [value, text] of [[0.25, "¼ speed"], [0.5, "½ speed"], [1, "1× speed"], [2, "2× speed"], [4, "4× speed"]]) {
        const option = make(speed, "option", "", text);
        option.value = value;
        option.selected = value === 1;
      }
      this.speed = speed;
      this.clock = make(bar, "output", "clock");
      this.slider = make(root, "input", "slider");
      Object.assign(this.slider, { type: "range", min: this.start, max: this.end, step: "any", value: this.start });
      this.slider.setAttribute("aria-label", "Time");
      this.lanes = make(root, "div", "lanes");
      this.inner = make(this.lanes, "div", "inner");
      this.legend();
      this.live = make(root, "p", "unseen");
      this.live.setAttribute("aria-live", "polite");
    }

    button(parent, text, title, action) {
      const node = make(parent, "button", "", text);
      node.type = "button";
      node.title = title;
      node.addEventListener("click", action);
      return node;
    }

    legend() {
      const used = [...new Set(this.bars.map((bar) => bar.action))].sort((a, b) => a - b);
      const list = make(this.root, "ul", "legend");
      for (const action of used) {
        const item = make(list, "li");
        make(item, "i").style.background = this.actions[action][1];
        make(item, "span", "", this.actions[action][0]);
      }
    }

    strip() {
      const seconds = (this.end - this.start) / 1000;
      this.inner.style.minWidth = Math.min(WIDEST, Math.round(seconds * ROOMY)) + "px";
      this.people.forEach((one, person) => {
        for (const kind of [FOUND, KNOWN, HELD]) {
          const mine = this.bars.filter((bar) => bar.person === person && bar.kind === kind);
          if (!mine.length && kind !== FOUND) continue;
          const lane = make(this.inner, "div", "lane");
          const who = one.name && kind === FOUND ? `person ${one.name}` : ROWS[kind];
          if (one.name || this.bars.some((bar) => bar.kind !== FOUND)) make(lane, "span", kind === FOUND ? "who" : "who less", who);
          const track = make(lane, "div", kind === FOUND ? "track" : "track thin");
          for (const bar of mine) this.place(track, bar);
        }
      });
      this.head = make(this.inner, "div", "playhead");
    }

    place(track, bar) {
      const node = this.button(track, "", this.title(bar), () => this.choose(this.bars.indexOf(bar)));
      node.tabIndex = -1;  // a thousand stops on the way through the page: the arrows lead to them
      node.className = ["found", "known", "held"][bar.kind];
      node.setAttribute("aria-label", this.title(bar));
      node.style.setProperty("--colour", this.actions[bar.action][1]);
      node.style.left = 100 * (bar.start - this.start) / (this.end - this.start) + "%";
      node.style.width = `max(${LEAST_BAR}px, ${100 * (bar.end - bar.start) / (this.end - this.start)}%)`;
      bar.node = node;
    }

    // a name stands in its bar where all of it fits; else the legend and the tooltip say it
    label() {
      const pen = document.createElement("canvas").getContext("2d");
      pen.font = "600 12px " + getComputedStyle(this.root).fontFamily;
      const wide = this.inner.clientWidth / (this.end - this.start);
      for (const bar of this.bars) {
        if (bar.kind !== FOUND) continue;
        const name = this.actions[bar.action][0];
        bar.node.textContent = pen.measureText(name).width + 10 <= (bar.end - bar.start) * wide ? name : "";
      }
    }

    listen() {
      this.root.addEventListener("keydown", (event) => this.key(event));
      this.slider.addEventListener("input", () => { this.choose(-1, false); this.seek(Number(this.slider.value)); });
      this.inner.addEventListener("click", (event) => {
        if (event.target.closest("button")) return;
        const box = this.inner.getBoundingClientRect();
        this.choose(-1, false);
        this.seek(this.start + (this.end - this.start) * (event.clientX - box.left) / box.width);
      });
      new ResizeObserver(() => { this.label(); this.draw(); }).observe(this.root);
      window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.recolour());
    }

    key(event) {
      if (event.altKey || event.ctrlKey || event.metaKey || event.target === this.speed) return;
      const step = event.shiftKey ? LONG_STEP : STEP;
      const does = {
        " ": () => this.play(!this.playing), ArrowLeft: () => this.step(-step), ArrowRight: () => this.step(step),
        ArrowUp: () => this.jump(-1), ArrowDown: () => this.jump(1), Escape: () => this.choose(-1),
        Home: () => this.step(-Infinity), End: () => this.step(Infinity),
      }[event.key];
      if (!does || (event.key === " " && event.target.tagName === "BUTTON")) return;
      event.preventDefault();
      does();
    }

    recolour() { this.ink = inks(this.root); this.draw(); }

    seek(time) {
      this.time = Math.min(this.end, Math.max(this.start, time));
      this.draw();
    }

    step(by) {
      this.play(false);
      this.seek(this.time + by);
    }

    jump(by) {
      const some = this.bars.filter((bar) => bar.kind === FOUND);
      const list = some.length ? some : this.bars;
      const chosen = this.bars[this.chosen];
      const from = chosen ? chosen.start : this.time;
      const place = list.indexOf(chosen);
      const next = by > 0 ? list.find((bar, i) => bar.start > from || (chosen && bar.start === from && i > place))
        : list.findLast((bar, i) => bar.start < from || (chosen && bar.start === from && i < place));
      if (next) this.choose(this.bars.indexOf(next));
    }

    // an action plays again and again beside its example; -1 = none is chosen
    choose(index, announce = true) {
      if (this.chosen >= 0) this.bars[this.chosen].node.removeAttribute("aria-current");
      this.chosen = index;
      if (index < 0) return this.draw();
      const bar = this.bars[index];
      bar.node.setAttribute("aria-current", "true");
      if (announce) this.live.textContent = this.title(bar);
      this.time = bar.start;
      return this.play(true);
    }

    play(on) {
      if (on && this.chosen < 0 && this.time >= this.end) this.time = this.start;
      if (on && !this.playing) { this.last = null; requestAnimationFrame((now) => this.tick(now)); }
      this.playing = on;
      this.draw();
    }

    tick(now) {
      if (!this.playing) return;
      if (this.last !== null) this.time += Math.min(250, now - this.last) * Number(this.speed.value);
      this.last = now;
      const bar = this.bars[this.chosen];
      if (bar && this.time >= bar.end) this.time = bar.start;
      if (this.time >= this.end) { this.time = this.end; this.playing = false; }
      this.draw();
      if (this.playing) requestAnimationFrame((again) => this.tick(again));
    }

    // what is beside the scene: the chosen action, or whatever is found at this moment
    current() {
      const now = this.bars.filter((bar) => bar.kind === FOUND && bar.start <= this.time && this.time < bar.end);
      return this.bars[this.chosen] || now[0];
    }

    middle() {
      if (!this.view[2]) return [0, 0];
      let x = 0, y = 0, count = 0;
      for (const shift of [-600, -300, 0, 300, 600]) {  // a steady hand
        const box = bounds(this.people.map((one) => one.at(this.time + shift, this.absent)));
        if (box) { x += (box[0] + box[2]) / 2; y += (box[1] + box[3]) / 2; count += 1; }
      }
      return count ? [x / count, 0] : [0, 0];
    }

    draw() {
      if (!this.ink) return;
      const bar = this.current();
      this.scene.begin(this.middle());
      let seen = 0;
      for (const one of this.people) {
        const pose = one.at(this.time, this.absent);
        if (pose) { this.scene.figure(pose, one.skeleton, this.ink, one.name); seen += 1; }
      }
      this.beside(bar);
      const doing = this.bars.filter((one) => one.kind === FOUND && one.start <= this.time && this.time < one.end);
      const whose = (name) => (name ? `person ${name}: ` : "");
      const tell = ({ person, action }) => whose(this.people[person].name) + this.actions[action][0];
      this.says.textContent = doing.length ? doing.map(tell).join(", ") : seen ? "no action" : "nobody in view";
      this.clock.textContent = `${(this.time / 1000).toFixed(2)} / ${clock(this.end)}`;
      this.slider.value = this.time;
      this.slider.setAttribute("aria-valuetext", `${clock(this.time)}, ${this.says.textContent}`);
      const share = (this.time - this.start) / (this.end - this.start);
      this.head.style.left = 100 * share + "%";
      this.follow(share);
      this.toggle.textContent = this.playing ? "Pause" : "Play";
      this.again.setAttribute("aria-pressed", String(this.chosen >= 0));
      this.again.disabled = this.chosen < 0;
      this.root.dataset.time = (this.time / 1000).toFixed(3);
    }

    follow(share) {
      const lanes = this.lanes, at = share * this.inner.clientWidth;
      if (lanes.scrollWidth <= lanes.clientWidth + 1) return;
      if (at < lanes.scrollLeft + 20 || at > lanes.scrollLeft + lanes.clientWidth - 20) lanes.scrollLeft = at - lanes.clientWidth / 4;
    }

    beside(bar) {
      const example = bar && this.examples[bar.example];
      this.side.view = example ? example.view : [1, 1, 0];
      this.side.begin([0, 0]);
      if (!example) {
        this.shows.textContent = bar ? "no example to show" : "the example of an action stands here while it lasts";
        return;
      }
      // as often as it fits, so that both run at about the same pace
      const lasts = Math.max(1, bar.end - bar.start), rounds = example.lasts ? Math.max(1, Math.round(lasts / example.lasts)) : 1;
      const phase = Math.min(0.9999, Math.max(0, (this.time - bar.start) / lasts)) * rounds;
      const times = example.track.times;
      const at = Math.min(times[times.length - 1], Math.max(times[0], phase % 1));
      const pose = example.track.at(at, 1e9);
      if (pose) this.side.figure(pose, example.track.skeleton, this.ink, "");
      const name = this.actions[bar.action][0];
      this.shows.textContent = `its example of ${name}` + (rounds > 1 ? `, ${rounds} times` : "");
      this.side.canvas.setAttribute("aria-label", `The example of ${name}`);
    }
  }

  for (const root of document.querySelectorAll(".player")) {
    try {
      new Player(root);
    } catch (error) {
      root.textContent = `This browser cannot show the player (${error.message}); all it shows is in the pictures and tables.`;
    }
  }
})();
