"use strict";
/* Curves over time that can be zoomed: drag over a stretch of time, double click for all of it; + - arrows 0 on the
   keyboard. Without this script, and in print, the page shows the same curves as still pictures. */
(() => {
  const SVG = "http://www.w3.org/2000/svg", LEFT = 58, RIGHT = 12, TOP = 20, AXIS = 36;
  const make = (parent, tag, attributes, text) => {
    const element = document.createElementNS(SVG, tag);
    for (const name in attributes) element.setAttribute(name, attributes[name]);
    if (text !== undefined) element.textContent = text;
    parent.appendChild(element);
    return element;
  };
  const decode = (text, scale) => {
    const raw = atob(text), values = new Float32Array(raw.length / 2);
    for (let k = 0; k < values.length; k++) {
      const whole = ((raw.charCodeAt(2 * k) | (raw.charCodeAt(2 * k + 1) << 8)) << 16) >> 16;
      values[k] = whole === -32768 ? NaN : whole * scale;
    }
    return values;
  };
  const ticks = (low, high, most) => {
    const raw = (high - low) / most, power = Math.pow(10, Math.floor(Math.log10(raw)));
    const step = [1, 2, 5, 10].map((x) => x * power).find((x) => x >= raw) || raw, out = [];
    for (let x = Math.ceil(low / step) * step; x <= high + 1e-9 * step; x += step) out.push(Math.abs(x) < 1e-9 * step ? 0 : x);
    return [out, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
  };
  const rms = (values, from, to) => {
    let sum = 0, count = 0;
    for (let k = from; k < to; k++) if (!Number.isNaN(values[k])) { sum += values[k] * values[k]; count++; }
    return count ? Math.sqrt(sum / count) : NaN;
  };

  class Chart {
    constructor(figure) {
      const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
      this.figure = figure;
      this.start = data.start_s;
      this.step = data.step_s;
      this.floor = data.floor_nm;
      const curves = {};
      for (const name in data.curves) curves[name] = decode(data.curves[name].values, data.curves[name].scale);
      this.panels = data.panels.map((p) => ({ ...p, lines: p.lines.map((l) => (
        { ...l, values: l.less ? curves[l.curve].map((v, k) => v - curves[l.less][k]) : curves[l.curve] })) }));
      this.count = curves.measured.length;
      this.all();
      this.box = document.createElement("div");
      this.box.className = "zoom";
      this.bar = document.createElement("p");
      this.bar.className = "soft small zoombar";
      for (const [text, label, act] of [
        ["+", "zoom in", () => this.scale(0.5)], ["−", "zoom out", () => this.scale(2)],
        ["←", "earlier", () => this.move(-0.4)], ["→", "later", () => this.move(0.4)], ["whole run", "whole run", () => this.all()],
      ]) {
        const button = document.createElement("button");
        button.type = "button"; button.textContent = text; button.setAttribute("aria-label", label);
        button.addEventListener("click", () => { act(); this.draw(); });
        this.bar.appendChild(button);
      }
      this.readout = document.createElement("span");
      this.bar.appendChild(this.readout);
      this.svg = make(this.box, "svg", { role: "img", tabindex: "0", "aria-label": figure.querySelector(".wide").getAttribute("aria-label") });
      figure.append(this.bar, this.box);
      figure.classList.add("live");
      this.listen();
      this.draw();
      new ResizeObserver(() => this.draw()).observe(this.box);
    }
    all() { this.from = 0; this.to = this.count; }
    clamp(from, to) {
      const width = Math.min(Math.max(to - from, 8), this.count);
      this.from = Math.round(Math.min(Math.max(from, 0), this.count - width));
      this.to = Math.round(this.from + width);
    }
    scale(by) { const m = 0.5 * (this.from + this.to), h = 0.5 * by * (this.to - this.from); this.clamp(m - h, m + h); }
    move(by) { const d = by * (this.to - this.from); this.clamp(this.from + d, this.to + d); }
    at(x) { return this.from + (x - LEFT) / (this.width - LEFT - RIGHT) * (this.to - this.from); }
    listen() {
      let down = null, veil = null;
      const x = (event) => event.clientX - this.svg.getBoundingClientRect().left;
      this.svg.addEventListener("pointerdown", (event) => {
        down = x(event); this.svg.setPointerCapture(event.pointerId);
        veil = make(this.svg, "rect", { x: down, y: 0, width: 0, height: this.height, class: "veil" });
      });
      this.svg.addEventListener("pointermove", (event) => {
        if (down === null) { this.read(this.at(x(event))); return; }
        veil.setAttribute("x", Math.min(down, x(event))); veil.setAttribute("width", Math.abs(x(event) - down));
      });
      this.svg.addEventListener("pointerup", (event) => {
        if (down === null) return;
        const a = this.at(Math.min(down, x(event))), b = this.at(Math.max(down, x(event))), far = Math.abs(x(event) - down) > 6;
        down = null; veil.remove();
        if (far) { this.clamp(a, b); this.draw(); }
      });
      this.svg.addEventListener("pointercancel", () => { down = null; if (veil) veil.remove(); });
      this.svg.addEventListener("dblclick", () => { this.all(); this.draw(); });
      this.svg.addEventListener("keydown", (event) => {
        const act = { "+": () => this.scale(0.5), "=": () => this.scale(0.5), "-": () => this.scale(2), 0: () => this.all(),
          ArrowLeft: () => this.move(-0.2), ArrowRight: () => this.move(0.2) }[event.key];
        if (act) { act(); this.draw(); event.preventDefault(); }
      });
    }
    read(place) {
      const k = Math.round(place);
      if (k < this.from || k >= this.to) return;
      const named = new Map();
      for (const p of this.panels) for (const l of p.lines) named.set((p.residual ? "difference " : "") + l.title, [l.values[k], p.unit]);
      const values = [...named].map(([name, [v, unit]]) => `${name} ${Number.isNaN(v) ? "–" : v.toPrecision(3)} ${unit}`);
      this.readout.textContent = `${(this.start + k * this.step).toFixed(3)} s: ${values.join(", ")}`;
    }
    path(values, x, y) {
      const columns = Math.max(1, Math.round(x(this.to) - x(this.from))), size = Math.max(1, (this.to - this.from) / columns);
      let text = "", open = false;
      for (let start = this.from; start < this.to; start += size) {
        let low = Infinity, high = -Infinity, gap = false;
        for (let k = Math.floor(start); k < Math.min(this.to, Math.floor(start + size)) || k === Math.floor(start); k++) {
          const v = values[k];
          if (Number.isNaN(v) || v === undefined) { gap = true; continue; }
          if (v < low) low = v;
          if (v > high) high = v;
        }
        if (low === Infinity) { open = false; continue; }
        const px = x(start + 0.5 * size).toFixed(1);
        text += `${open ? "L" : "M"}${px} ${y(low).toFixed(1)}`;
        if (high > low) text += `L${px} ${y(high).toFixed(1)}`;
        open = !gap;
      }
      return text;
    }
    draw() {
      this.width = Math.max(this.box.clientWidth, 280);
      const part = this.width < 560 ? 42 : 54, heights = this.panels.map((p) => part * p.height);
      const legend = (p) => this.width < 760 && p.lines.length > 1 ? 15 * p.lines.length : 0;  // a row for each curve
      this.height = heights.reduce((a, b, k) => a + b + TOP + legend(this.panels[k]), 0) + AXIS;
      this.svg.replaceChildren();
      this.svg.setAttribute("viewBox", `0 0 ${this.width} ${this.height}`);
      const x = (k) => LEFT + (k - this.from) / (this.to - this.from) * (this.width - LEFT - RIGHT);
      const t0 = this.start + this.from * this.step, t1 = this.start + this.to * this.step;
      const [times, digits] = ticks(t0, t1, this.width / 90);
      const range = (panels) => {
        let least = Infinity, most = -Infinity;
        for (const p of panels) for (const l of p.lines) for (let k = this.from; k < this.to; k++) {
          if (l.values[k] < least) least = l.values[k];
          if (l.values[k] > most) most = l.values[k];
        }
        if (!(most > least)) { least = (least === Infinity ? 0 : least) - 1; most = least + 2; }
        return [least - 0.06 * (most - least), most + 0.06 * (most - least)];
      };
      const torque = range(this.panels.filter((p) => p.unit === "Nm" && !p.residual));
      let top = 0;
      this.panels.forEach((p, place) => {
        top += TOP + legend(p);
        const height = heights[place], base = top;
        let [least, most] = p.residual || p.unit !== "Nm" ? range([p]) : torque;
        if (p.residual) { most = Math.max(-least, most, 2.6 * (this.floor || 0)); least = -most; }
        const y = (v) => base + (most - v) / (most - least) * height;
        if (p.residual && this.floor) make(this.svg, "rect", { x: LEFT, width: this.width - LEFT - RIGHT, y: y(2 * this.floor), height: y(-2 * this.floor) - y(2 * this.floor), class: "floor" });
        const [levels, places] = ticks(least, most, Math.max(height / 34, 2.5));
        for (const v of levels) {
          make(this.svg, "line", { x1: LEFT, x2: this.width - RIGHT, y1: y(v), y2: y(v), class: "grid" });
          make(this.svg, "text", { x: LEFT - 6, y: y(v) + 4, "text-anchor": "end" }, v.toFixed(places));
        }
        for (const t of times) make(this.svg, "line", { x1: x((t - this.start) / this.step), x2: x((t - this.start) / this.step), y1: top, y2: top + height, class: "grid" });
        const title = make(this.svg, "text", { x: LEFT, y: top - 6 - legend(p), class: "title" }, `${p.title} [${p.unit}]`);
        for (const l of p.lines) {
          make(this.svg, "path", { d: this.path(l.values, x, y), style: `stroke:var(--${l.role})` });
          const size = p.residual ? ` ${rms(l.values, this.from, this.to).toPrecision(3)} Nm rms` : "";
          if (p.lines.length > 1) make(title, "tspan", { ...(legend(p) ? { x: LEFT, dy: 15 } : { dx: 14 }), style: `fill:var(--${l.role})` }, `${l.title}${size}`);
        }
        top += height;
      });
      for (const t of times) make(this.svg, "text", { x: x((t - this.start) / this.step), y: top + 16, "text-anchor": "middle" }, t.toFixed(digits));
      make(this.svg, "text", { x: 0.5 * (LEFT + this.width), y: top + 32, "text-anchor": "middle" }, "time [s]");
      this.readout.textContent = this.to - this.from < this.count ? `${t0.toFixed(2)} to ${t1.toFixed(2)} s; double click: whole run` : "drag over a stretch of time to zoom";
    }
  }
  for (const figure of document.querySelectorAll("figure[data-trace]")) new Chart(figure);
})();
