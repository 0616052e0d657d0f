// As much of a browser as rig.js needs, for node: elements, events, a canvas that remembers the lines drawn on it.
class Node_ {
  constructor(tag) {
    Object.assign(this, { tagName: tag.toUpperCase(), dataset: {}, attributes: {}, children: [], heard: {}, className: "", value: "", style: {} });
    this.clientWidth = 600;
    this.clientHeight = 400;
    this.text = "";
  }
  set textContent(text) { this.text = text; this.children = []; }
  get textContent() { return this.text; }
  append(...nodes) { this.children.push(...nodes); }
  setAttribute(name, value) { this.attributes[name] = value; }
  removeAttribute(name) { if (name.startsWith("data-")) delete this.dataset[name.slice(5)]; else delete this.attributes[name]; }
  addEventListener(name, hear) { (this.heard[name] ||= []).push(hear); }
  dispatchEvent(event) { event.target ||= this; for (const hear of this.heard[event.type] || []) hear(event); }
  click() { this.dispatchEvent({ type: "click" }); }
  every() { return [this, ...this.children.flatMap((child) => child.every())]; }
  querySelector(tag) { return this.every().find((node) => node.tagName === tag.toUpperCase()); }
  querySelectorAll(tag) { return this.every().filter((node) => node.tagName === tag.toUpperCase()); }
  getContext() { return this.pen ||= new Pen(); }
}
class Pen {
  constructor() { this.lines = []; this.texts = []; }
  setTransform() {}
  clearRect() { this.lines = []; this.texts = []; }
  beginPath() {}
  moveTo(x, y) { this.from = [x, y]; }
  lineTo(x, y) { this.lines.push([this.strokeStyle, ...this.from, x, y]); }
  stroke() {}
  strokeRect() {}
  fillText(text, x, y) { this.texts.push([text, x, y]); }
  arc() {}
  fill() {}
}
const roots = [];
globalThis.window = globalThis;
globalThis.devicePixelRatio = 1;
globalThis.matchMedia = () => ({ addEventListener() {} });
globalThis.ResizeObserver = class { observe() {} };
globalThis.getComputedStyle = () => ({ getPropertyValue: (name) => name, fontFamily: "serif" });
globalThis.document = { createElement: (tag) => new Node_(tag), querySelectorAll: () => roots, querySelector: () => roots[0] };
globalThis.KeyboardEvent = class { constructor(type, more) { Object.assign(this, { type, preventDefault() {} }, more); } };
globalThis.PointerEvent = globalThis.KeyboardEvent;
globalThis.page = (data) => { const root = new Node_("div"); root.dataset.rig = data; roots.push(root); return root; };
