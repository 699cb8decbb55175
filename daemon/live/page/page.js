"use strict";
// The page of jtqd's live view. It draws what the server-sent events of /events hold: `samples` (fields of the log, 20 times a
// second) and `state` (jtq.status/1 of `jtq status --json`, with histograms). It sends nothing.

const KEPT_S = 65, GAP_S = 0.2, SILENT_MS = 2000;
const LEVELS = { // status -> level, glyph: form and word tell it, colour only repeats it
  valid: ["ok", "✓"], standstill: ["info", "◆"], starting: ["info", "…"], degraded: ["warn", "▲"],
  stale: ["bad", "✕"], drive_fault: ["bad", "✕"], invalid: ["bad", "✕"], off: ["off", "○"],
};
const RANK = ["off", "ok", "info", "warn", "bad"];
const SEVERITY = { error: ["bad", "✕"], warning: ["warn", "▲"], info: ["info", "◆"] };
const STATUS_LEVEL = { 0: "off", 1: "info", 3: "warn", 4: "bad", 5: "bad", 6: "info", 15: "bad" };
const DASHES = { tob: [7, 4], efficiency: [2, 3], network: [9, 3, 2, 3], fused: [4, 2] };
const TESTS = { sensor: "to sensor, 3 σ", network: "network − physics", link_zero: "link zero", contact: "contact" };

const byId = (id) => document.getElementById(id);
const number = (value, digits, signed) => {
  if (value === null || value === undefined) return "–";
  const text = value.toFixed(digits).replace("-", "−");
  return signed && value >= 0 ? "+" + text : text;
};
const whole = (value) => value.toLocaleString("en").replace(/,/g, "\u202f");
const words = (text) => text.replace(/_/g, " ");
const put = (element, text) => { if (element.textContent !== text) element.textContent = text; };
const made = (name, text, classes) => {
  const element = document.createElement(name);
  if (text !== undefined) element.textContent = text;
  if (classes) element.className = classes;
  return element;
};
const mark = (element, [level, glyph], word) => {
  element.classList.remove(...RANK);
  element.classList.add(level);
  put(element.querySelector(".glyph"), glyph);
  put(element.querySelector(".word"), word);
};
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

let windowS = 20, paused = false, state = null, heardMs = 0, newest = 0;
const cards = [];

// ---- plots ----

function axis(more) {
  return { stroke: colour("soft"), grid: { stroke: colour("line"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif", ...more };
}

function plot(place, options, data) {
  place.replaceChildren();
  const size = () => ({ width: Math.max(place.clientWidth, 100), height: place.clientHeight });
  const shown = new uPlot({ legend: { show: false }, padding: [8, 26, 0, 0], ...size(), ...options }, data, place);
  new ResizeObserver(() => { if (shown.width !== size().width) shown.setSize(size()); }).observe(place);
  return shown;
}

function timePlot(card, place, series, bands, range, scale, drawn) {
  return plot(place, {
    cursor: { sync: { key: "joint " + card.number }, drag: { x: false, y: false }, points: { show: false } },
    scales: { x: { time: true, range: () => [newest - windowS, newest] }, y: { range } },
    series: [{}, ...series.map((each) => ({ points: { show: false }, spanGaps: false, ...each }))],
    bands,
    axes: [axis({ size: 26, space: 70, values: [[1, "{HH}:{mm}:{ss}", null, null, null, null, null, null, 1]] }), axis({ size: 46, ...scale })],
    hooks: { draw: [drawn] },
  }, card.data(series.map((each) => each.key)));
}

function ribbon(card) { // times without a valid estimate, at the lower edge
  return (u) => {
    const { left, top, width, height } = u.bbox, high = 5 * uPlot.pxRatio, times = card.columns.time_s, codes = card.columns.status;
    for (let n = 1; n < times.length; n++) {
      const level = STATUS_LEVEL[codes[n]];
      if (!level || times[n - 1] < newest - windowS || times[n] - times[n - 1] > GAP_S) continue;
      const from = u.valToPos(times[n - 1], "x", true), to = u.valToPos(times[n], "x", true);
      u.ctx.fillStyle = colour("ribbon-" + level);
      u.ctx.fillRect(Math.max(from, left), top + height - high, Math.min(to, left + width) - Math.max(from, left) + 1, high);
    }
  };
}

function padded(u, low, high) {
  if (low === null || low === undefined) return [-1, 1];
  const rest = Math.max((high - low) * 0.08, 0.5);
  return [low - rest, high + rest];
}

class Card {
  constructor(index) {
    this.number = index + 1;
    this.methods = [];
    this.element = byId("joint").content.firstElementChild.cloneNode(true);
    this.element.setAttribute("aria-labelledby", "joint-" + this.number);
    this.find(".name").id = "joint-" + this.number;
    this.hidden = new Set();
    this.columns = {};
    this.rows = {};
    for (const name of ["estimate", "sensor"]) this.addRow(name);
    byId("joints").append(this.element);
  }

  find(selector) { return this.element.querySelector(selector); }

  addMethod(name) { // in the first cycles none is known
    this.methods.push(name);
    this.addRow(name);
    if (this.columns.time_s) this.columns[name + "_ratio"] = this.columns.time_s.map(() => null);
    this.trace = null;
  }

  addRow(key) {
    const row = made("tr"), head = made("th"), button = made("button");
    head.scope = "row";
    button.type = "button";
    button.title = "show or hide";
    button.setAttribute("aria-pressed", "true");
    button.append(made("span", "", "key " + key), key);
    button.addEventListener("click", () => {
      const hide = !this.hidden.delete(key);
      if (hide) this.hidden.add(key);
      button.setAttribute("aria-pressed", String(!hide));
      this.draw();
    });
    head.append(button);
    row.append(head, ...[0, 1, 2, 3].map(() => made("td", "")));
    this.find("tbody").append(row);
    this.rows[key] = row;
  }

  // samples: one array per field of the log
  take(times, fields) {
    const columns = this.columns;
    if (!columns.time_s) for (const key of ["time_s", ...Object.keys(fields), "upper", "lower", "ratio", ...this.methods.map((each) => each + "_ratio")]) columns[key] = [];
    const last = columns.time_s.at(-1);
    if (last !== undefined && times[0] - last > GAP_S) { // no line across what was not seen
      for (const key in columns) columns[key].push(key === "time_s" ? last + 0.001 : null);
    }
    columns.time_s.push(...times);
    for (const key in fields) columns[key].push(...fields[key]);
    for (let n = 0; n < times.length; n++) {
      const torque = fields.torque_nm[n], sigma = fields.sigma_nm[n], known = torque !== null && sigma !== null;
      columns.upper.push(known ? torque + sigma : null);
      columns.lower.push(known ? torque - sigma : null);
      for (const name of ["", ...this.methods.map((each) => each + "_")]) {
        const [value, width, sensor] = ["torque_nm", "sigma_nm", "reference_nm"].map((each) => fields[name + each][n]);
        columns[name + "ratio"].push(value === null || sensor === null || !width ? null : (value - sensor) / width);
      }
    }
    const old = columns.time_s.findIndex((each) => each > newest - KEPT_S);
    if (old > 200) for (const key in columns) columns[key].splice(0, old);
  }

  data(keys) { return [this.columns.time_s, ...keys.map((key) => this.columns[key])]; }

  build() {
    const line = (key, name, more) => ({ key, label: name, stroke: colour(name), width: 1.5, ...more });
    const shadows = this.methods.map((each) => line(each + "_torque_nm", each, { dash: DASHES[each] }));
    const edge = (key) => ({ key, label: key, stroke: "transparent", width: 0 });
    this.series = [...shadows, edge("upper"), edge("lower"), line("torque_nm", "estimate", { width: 2.5 }), line("reference_nm", "sensor", { width: 1 })];
    const at = this.series.findIndex((each) => each.key === "upper") + 1;
    this.trace = timePlot(this, this.find(".trace"), this.series, [{ series: [at, at + 1], fill: colour("band") }], padded, {}, ribbon(this));
    this.ratios = [...this.methods.map((each) => line(each + "_ratio", each, { dash: DASHES[each], width: 1 })), line("ratio", "estimate")];
    const limits = (u) => {
      u.ctx.strokeStyle = colour("soft");
      u.ctx.setLineDash([4 * uPlot.pxRatio, 4 * uPlot.pxRatio]);
      for (const limit of [-3, 3]) {
        const y = u.valToPos(limit, "y", true);
        u.ctx.beginPath();
        u.ctx.moveTo(u.bbox.left, y);
        u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
        u.ctx.stroke();
      }
      u.ctx.setLineDash([]);
    };
    const range = (u, low, high) => [Math.min(-3.5, Math.max(low ?? 0, -12)), Math.max(3.5, Math.min(high ?? 0, 12))];
    this.ratio = timePlot(this, this.find(".ratio"), this.ratios, [], range, { splits: () => [-3, 0, 3] }, limits);
  }

  draw() {
    if (!this.columns.time_s) return;
    if (!this.trace) this.build();
    const rows = { torque_nm: "estimate", upper: "estimate", lower: "estimate", ratio: "estimate", reference_nm: "sensor" };
    for (const [shown, series] of [[this.trace, this.series], [this.ratio, this.ratios]]) {
      series.forEach((each, n) => {
        const show = !this.hidden.has(rows[each.key] ?? each.key.replace(/_.*/, ""));
        if (shown.series[n + 1].show !== show) shown.setSeries(n + 1, { show });
      });
      shown.setData(this.data(series.map((each) => each.key)));
    }
  }

  show(joint = this.joint) {
    if (!joint) return;
    this.joint = joint;
    for (const name of Object.keys(joint.shadow)) if (!this.methods.includes(name)) this.addMethod(name);
    put(this.find(".name"), "Joint " + joint.joint + (/^joint_?\d$/.test(joint.name) ? "" : ", " + joint.name));
    mark(this.find(".badge"), LEVELS[joint.status] ?? ["bad", "✕"], words(joint.status));
    put(this.find(".torque b"), joint.torque_nm === null ? "no torque" : number(joint.torque_nm, 2, true));
    this.find(".unit").hidden = joint.torque_nm === null;
    put(this.find(".sigma"), joint.sigma_nm === null ? "" : "± " + number(joint.sigma_nm, 2));
    this.find(".ratios").hidden = joint.reference_nm === null && !this.columns.ratio?.some((each) => each !== null);
    put(this.find(".reason"), joint.reason ?? "");
    this.cells("estimate", joint.torque_nm, joint.sigma_nm, joint.error_nm, joint.rmse_nm);
    this.cells("sensor", joint.reference_nm);
    for (const name of this.methods) {
      const each = joint.shadow[name];
      if (!each) continue;
      const error = each.torque_nm === null || each.reference_nm === null ? null : each.torque_nm - each.reference_nm;
      this.cells(name, each.torque_nm, each.sigma_nm, error, each.rmse_nm);
    }
    bars(this.find(".tests"), Object.entries(joint.ratios).map(([name, share]) => [TESTS[name] ?? name, share, number(share, 2) + " of limit"]));
    const total = Object.values(joint.cycles).reduce((sum, each) => sum + each, 0);
    const published = ["valid", "degraded", "standstill"].reduce((sum, each) => sum + (joint.cycles[each] ?? 0), 0);
    facts(this.find(".facts"), [
      ["with a torque", total ? number(100 * published / total, 2) + " % of cycles" : "–"],
      ["age of the estimate", number(joint.age_ms, 2) + " ms"],
      ["contact", joint.contact === null ? "not known" : joint.contact ? number(joint.contact_nm, 1, true) + " Nm" : "none"],
      ["drive", joint.drive],
      ["motor current", number(joint.current_a, 2, true) + " A"],
      ["motor velocity", number(joint.motor_velocity_rad_s, 1, true) + " rad/s"],
      ["temperature", number(joint.temperature_c, 1) + " °C"],
    ]);
    const text = `Torque of joint ${joint.joint} over ${windowS} s: ${number(joint.torque_nm, 2, true)} Nm, sigma ${number(joint.sigma_nm, 2)} Nm`;
    this.find(".trace").setAttribute("aria-label", text);
    this.find(".ratio").setAttribute("aria-label", `Differences of joint ${joint.joint} in sigma, limits at 3`);
  }

  cells(key, torque, ...others) {
    const at = this.trace?.cursor.idx, field = { estimate: "torque_nm", sensor: "reference_nm" }[key] ?? key + "_torque_nm";
    const pointed = at !== null && at !== undefined;
    const cells = this.rows[key].querySelectorAll("td");
    put(cells[0], number(pointed ? this.columns[field]?.[at] : torque, 2, true));
    others.forEach((each, n) => put(cells[n + 1], pointed ? "" : number(each, 2, n === 1)));
  }
}

let histogram = null;

function drawHistogram({ bin_us: width, work, late }) {
  const length = Math.max(work.length, late.length, 1), step = Math.ceil(length / 90);
  const sum = (bins, n) => bins.slice(n * step, (n + 1) * step).reduce((total, each) => total + each, 0) || null;
  const count = Math.ceil(length / step), bins = [...Array(count).keys()];
  const data = [bins.map((n) => (n + 0.5) * step * width), bins.map((n) => sum(work, n)), bins.map((n) => sum(late, n))];
  const top = Math.max(10, ...data[1], ...data[2]);
  histogram ??= plot(byId("histogram"), {
    cursor: { show: false },
    scales: { x: { time: false, range: () => [0, histogram?.end ?? count * step * width] }, y: { distr: 3, range: () => [0.7, histogram?.top ?? top * 2] } },
    series: [{},
      { stroke: colour("estimate"), fill: colour("estimate"), width: 0, paths: uPlot.paths.bars({ size: [0.9, 40] }), fillTo: (u) => u.scales.y.min, points: { show: false } },
      { stroke: colour("motor"), width: 2, paths: uPlot.paths.stepped({ align: 1 }), points: { show: false } }],
    axes: [axis({ size: 26, space: 60, values: (u, at) => at.map((each) => each + " µs") }),
      axis({ size: 46, splits: () => [1, 10, 100, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8], filter: (u, at) => at, values: (u, at) => at.map((each) => (Math.log10(each) % 2 ? "" : each < 1e3 ? each : each < 1e6 ? each / 1e3 + "k" : each / 1e6 + "M")) })],
  }, data);
  histogram.end = count * step * width;
  histogram.top = top * 2;
  histogram.setData(data);
}

// ---- numbers ----

function list(place, rows, create, fill) { // one element per row, kept: a screen reader stays where it is
  while (place.children.length > rows.length) place.lastElementChild.remove();
  while (place.children.length < rows.length) place.append(create());
  rows.forEach((row, n) => fill(place.children[n], row));
}

function facts(place, rows) {
  const create = () => { const each = made("div"); each.append(made("dt"), made("dd")); return each; };
  list(place, rows, create, (each, [name, text]) => { put(each.firstChild, name); put(each.lastChild, text); });
}

function bars(place, rows) { // [name, share of 1, text, optional mark]
  const shown = rows.filter(([, share]) => share !== null && share !== undefined);
  const create = () => {
    const each = made("div"), track = made("dd", undefined, "track");
    track.setAttribute("aria-hidden", "true");
    track.append(made("i"), made("u"));
    each.append(made("dt"), track, made("dd", undefined, "value"));
    return each;
  };
  list(place, shown, create, (each, [name, share, text, at]) => {
    const [title, track, value] = each.children;
    put(title, name);
    put(value, text);
    track.firstChild.style.width = 100 * Math.min(share, 1) + "%";
    track.firstChild.classList.toggle("over", share > 1);
    track.lastChild.hidden = at === undefined;
    if (at !== undefined) track.lastChild.style.left = 100 * Math.min(at, 1) + "%";
  });
}

function lines(place, rows, nothing) {
  list(place, rows.length ? rows : [[["off", ""], nothing]], () => { const each = made("li"); each.append(made("b"), made("span")); return each; }, (each, [[level, glyph], text]) => {
    each.firstChild.className = level;
    put(each.firstChild, glyph);
    put(each.lastChild, text);
  });
}

function showVerdict() {
  let kind = ["ok", "✓"], text;
  if (!heardMs) [kind, text] = [["info", "…"], "Connecting"];
  else if (performance.now() - heardMs > SILENT_MS) [kind, text] = [["bad", "✕"], "No connection to jtqd"];
  else if (!state) [kind, text] = [["info", "…"], "Waiting for jtqd"];
  else if (state.state === "starting") [kind, text] = [["info", "…"], "Starting: " + state.why];
  else if (state.state !== "running") [kind, text] = [["bad", "✕"], "No cycles: " + state.why];
  else {
    const level = (joint) => (LEVELS[joint.status] ?? ["bad"])[0];
    const worst = state.joints.reduce((found, each) => (RANK.indexOf(level(each)) > RANK.indexOf(level(found)) ? each : found));
    const errors = state.conditions.filter((each) => each.severity === "error").length;
    kind = LEVELS[worst.status] ?? ["bad", "✕"];
    text = state.joints.every((each) => each.status === worst.status)
      ? (state.joints.length > 1 ? "All joints " : "Joint ") + words(worst.status)
      : `Joint ${worst.joint} ${words(worst.status)}`;
    if (errors && kind[0] !== "bad") [kind, text] = [["bad", "✕"], errors + (errors > 1 ? " errors" : " error")];
  }
  mark(byId("verdict"), kind, text);
  document.body.classList.toggle("still", kind[0] === "bad" && !/^(Joint|All|\d)/.test(text));
  document.title = `${kind[1]} jtqd ${state?.instance ?? ""}: ${text}`;
}

function showState() {
  put(byId("bus"), `on ${state.instance}`);
  if (!state.joints) return;
  while (cards.length < state.joints.length) cards.push(new Card(cards.length));
  state.joints.forEach((each, n) => cards[n].show(each));
  const { bus_load: load, counters, work_us: work, late_us: late, bus_state: bus, recorder } = state;
  lines(byId("conditions"), state.conditions.map((each) => [SEVERITY[each.severity] ?? ["info", "◆"], `${each.subject}: ${each.text} (for ${number(each.for_s, 1)} s)`]), "None");
  const clock = (ns) => new Date(ns / 1e6).toTimeString().slice(0, 8);
  lines(byId("notices"), state.notices.slice(-5).reverse().map((each) => [[each.level >= 40 ? "bad" : each.level >= 30 ? "warn" : "info", clock(each.realtime_ns)], each.text]), "None");
  bars(byId("load"), [["load", load.now, load.now === null ? "" : number(100 * load.now, 1) + " %", load.worst_case]]);
  const seen = ["late_frames", "duplicate_frames", "rejected_frames", "foreign_sync", "sync_errors", "tx_dropped", "rx_dropped"].filter((name) => counters[name]);
  facts(byId("bus-facts"), [
    ["worst case (mark)", number(100 * load.worst_case, 1) + " %"],
    ...(bus.state ? [["state", words(String(bus.state))]] : []),
    ...state.nodes.map((each) => [`node ${each.node}, ${each.what}`, each.state ?? "not heard"]),
    ...seen.map((name) => [words(name), whole(counters[name])]),
  ]);
  facts(byId("cycle-facts"), [
    ["work, median", number(work.p50, 0) + " µs"], ["99 %", number(work.p99, 0) + " µs"], ["longest", number(work.max, 0) + " µs"],
    ["lateness, 99 %", number(late.p99, 0) + " µs"], ["largest", number(late.max, 0) + " µs"], ["period", whole(state.page.period_us) + " µs"],
    ["cycles", whole(counters.cycles)], ["missed", whole(counters.missed)], ["stale inputs", whole(counters.stale_inputs)],
    ...(recorder ? [["not in the log", whole(recorder.lost)]] : []),
  ]);
  drawHistogram(state.page);
}

// ---- events ----

let source = null;

function connect() {
  source?.close();
  source = null;
  if (document.hidden) return; // a page that nobody sees costs nothing
  source = new EventSource("events");
  source.addEventListener("samples", (event) => {
    heardMs = performance.now();
    if (paused) return; // plots stand still, status and numbers go on
    const found = JSON.parse(event.data);
    if (!found.time_s.length || found.joints.length > cards.length) return;
    newest = found.time_s.at(-1);
    found.joints.forEach((fields, n) => { cards[n].take(found.time_s, fields); cards[n].draw(); });
    put(byId("clock").firstChild, new Date(newest * 1000).toTimeString().slice(0, 8));
    put(byId("clock").lastChild, "cycle " + whole(found.cycle.at(-1)));
  });
  source.addEventListener("state", (event) => {
    heardMs = performance.now();
    state = JSON.parse(event.data);
    showState();
    showVerdict();
  });
}

document.addEventListener("visibilitychange", connect);
byId("window").addEventListener("change", (event) => { windowS = Number(event.target.value); cards.forEach((each) => each.draw()); });
byId("pause").addEventListener("click", (event) => {
  paused = !paused;
  event.target.setAttribute("aria-pressed", String(paused));
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  histogram = null;
  for (const card of cards) { card.trace = null; card.draw(); }
  if (state?.joints) showState();
});
setInterval(showVerdict, 500);
connect();
