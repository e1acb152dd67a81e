// The page of the running bench. It draws what the server sends and asks for a stop; it decides
// nothing. Text from files goes into the page as text only, never as markup.
"use strict";

const BIN_S = 0.05, KEPT = 3600, MOST_EVENTS = 200, LOST_MS = 2500, OLD_S = 2, NIGHT_OLD_S = 20;
const $ = id => document.getElementById(id);
const token = takeToken();
let series = {}, curve = [], events = [], spectrum = null, generation = -1, charts = {};
let last = null, lastFrameAt = performance.now(), paused = false, night = {}, tab = "now", made = null, listed = "", asked = "", chosen = "", refused = false, fresh = false;
let nightAt = "", nightOld = "", reading = {};

function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname); // not left in the address for others to see
  }
  return given || sessionStorage.getItem("token") || "";
}
addEventListener("hashchange", () => location.reload()); // another address of this page was pasted

function ask(path, options = {}) {
  return fetch(path, {...options, headers: {Authorization: "Bearer " + token, ...options.headers}});
}

function element(name, text, attributes = {}) {
  const made = document.createElement(name);
  if (text !== undefined && text !== null) made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function write(node, text) { // only when it changes: a screen reader says each writing, a selection is lost
  if (node.textContent !== String(text)) node.textContent = text;
}

function say(id, text) {
  write($(id), text);
}

function fill(list, items, make, update) { // keeps the elements that are there
  while (list.children.length > items.length) list.lastChild.remove();
  items.forEach((item, n) => update(list.children[n] || list.appendChild(make()), item));
}

function notice(text) {
  $("notice").textContent = text;
  $("notice").hidden = !text;
}

// --- the stream of frames -----------------------------------------------------------------------

async function watch() {
  for (;;) {
    let reader = null;
    try {
      const answer = await ask("/api/live");
      if (answer.status === 401 || answer.status === 403) {
        notice((await answer.text()) + ". Open the address that rig page printed.");
        return;
      }
      if (!answer.ok) notice(await answer.text()); // too many viewers: tried again
      else {
        if (refused) notice("");
        generation = -1;
        reader = answer.body.getReader();
        await read(reader);
      }
      refused = !answer.ok;
    } catch (error) { /* the server is gone or restarts: said by the word, tried again */
      if (reader) {
        console.warn(error);
        reader.cancel().catch(() => {}); // else the server continues to send
      }
    }
    await new Promise(go => setTimeout(go, 1000));
  }
}

async function read(reader) {
  const decoder = new TextDecoder();
  let rest = "";
  for (;;) {
    const {value, done} = await reader.read();
    if (done) return;
    const parts = (rest + decoder.decode(value, {stream: true})).split("\n\n");
    rest = parts.pop();
    for (const part of parts) if (part.startsWith("data: ")) take(JSON.parse(part.slice(6)));
  }
}

function take(frame) {
  if (frame.gen !== generation) {
    generation = frame.gen;
    series = {}; curve = []; events = []; spectrum = null;
    for (const one of Object.values(charts)) one.plot.destroy();
    charts = {};
    $("charts").replaceChildren();
    $("events").replaceChildren();
  }
  for (const [name, news] of Object.entries(frame.series)) merge(name, news, frame.run.streams[name]);
  curve = curve.concat(frame.curve);
  if (frame.spectrum !== undefined) spectrum = frame.spectrum;
  addEvents(frame.events);
  last = frame;
  lastFrameAt = performance.now();
  show();
}

function merge(name, news, about) {
  const channels = about.channels.length;
  const mine = series[name] ||= {k: [], low: about.channels.map(() => []), high: about.channels.map(() => [])};
  if (!news.k.length) return;
  while (mine.k.length && mine.k[mine.k.length - 1] >= news.k[0]) { // sent again, since it has grown
    mine.k.pop();
    for (let c = 0; c < channels; c++) { mine.low[c].pop(); mine.high[c].pop(); }
  }
  mine.k.push(...news.k);
  for (let c = 0; c < channels; c++) { mine.low[c].push(...news.low[c]); mine.high[c].push(...news.high[c]); }
  const over = mine.k.length - KEPT;
  if (over > 0) {
    mine.k.splice(0, over);
    for (let c = 0; c < channels; c++) { mine.low[c].splice(0, over); mine.high[c].splice(0, over); }
  }
}

// --- the word, the numbers ----------------------------------------------------------------------

function showWord() {
  const silent = performance.now() - lastFrameAt;
  let word = "unknown", reason = "connecting …";
  if (last && silent < LOST_MS) { word = last.word; reason = last.reason; }
  else if (last) reason = `for ${(silent / 1000).toFixed(0)} s: no connection to the page's server`;
  $("word").className = word;
  say("word-text", word);
  say("word-reason", reason);
  const mark = last ? markOf(last) : "";
  document.title = `${mark ? mark + " " : ""}${word} · rig page`;
}

function markOf(frame) { // of the run, or of the file of the latest one
  return frame.run.mark || (frame.last_file && frame.last_file.mark) || "";
}

function span(seconds) {
  if (seconds === null || seconds === undefined) return "not known yet";
  const s = Math.round(seconds);
  if (s < 100) return s + " s";
  if (s < 6000) return `${Math.floor(s / 60)} min ${s % 60} s`;
  return `${Math.floor(s / 3600)} h ${Math.floor(s % 3600 / 60)} min`;
}

function when(iso) { // to the second, with its zone: who watches may be elsewhere
  return (iso || "").replace("T", " ").replace(/\.\d+/, "");
}

function show() {
  showWord();
  const run = last.run;
  const mark = markOf(last);
  $("mark").hidden = !mark;
  $("mark").textContent = `${mark}: these are not measurements`;
  document.body.classList.toggle("marked", !!mark);
  document.body.dataset.mark = mark;
  if (made && made.done && (isHeld(last) || made.gen !== last.gen)) made = null; // of an earlier state
  showStop();
  $("clock").textContent = "server " + last.time;
  $("late").hidden = !last.late;
  $("late").textContent = last.late;
  $("make-safe").hidden = !last.can_make_safe;
  if (tab !== "now" || paused || document.hidden) return;
  showFacts(run);
  showNumbers(run);
  draw(run);
}

function showFacts(run) {
  const facts = [];
  if (night.running) facts.push(["batch", `${night.name}: ${ended(night.runs)} of ${total(night.runs)} runs over${nightOld ? " (old)" : ""}`]);
  if (run.procedure) {
    const died = !run.end && !last.holder; // it has no point and no time left, whatever it had planned
    facts.push(["run", run.procedure + (run.end ? ` (${run.end.status}, exit ${run.end.exit})` : died ? " (interrupted)" : "")]);
    facts.push(["point", `${died ? run.done : run.n} of ${run.planned}`], ["open point", died ? "none" : run.point || "none"]);
    if (run.valid !== null) facts.push(["valid", `${run.valid} of ${run.done} recorded`]);
    facts.push(["time left", run.end ? "ended" : died ? "interrupted" : (run.left_s === null ? "" : "about ") + span(run.left_s)], ["time in the run", span(run.last_s)]);
    facts.push(["sample", run.sample || "not named"], ["started", when(run.start)]);
    facts.push(["process", last.holder ? `${last.holder.pid} (${last.holder.user})` : "none"]);
    if (run.set_point_N !== null) facts.push(["set point", `${run.set_point_N} N${run.set_point_changes ? " (changes in a trial)" : ""}`]);
    if (run.discarded) facts.push(["discarded attempts", run.discarded]);
  } else if (last.last_file) {
    facts.push(["latest run", last.last_file.file], ["it ended", `${last.last_file.status}, exit ${last.last_file.exit}`]);
  } else facts.push(["run", "none yet; the next run appears here automatically"]);
  const pair = () => {
    const made = element("div");
    made.append(element("dt"), element("dd"));
    return made;
  };
  fill($("facts"), facts, pair, (one, [name, value]) => { write(one.firstChild, name); write(one.lastChild, value); });
}

function readOut(value, units) { // volts of a film are small: 85.7 µV, not 0.0000857 V
  if (value === null || value === undefined) return ["–", units];
  const size = Math.abs(value);
  if (units === "V" && size < 0.1) return size < 1e-3 ? [(value * 1e6).toFixed(1), "µV"] : [(value * 1e3).toFixed(2), "mV"];
  return [value.toFixed(size < 10 ? 3 : size < 1000 ? 2 : 0), units];
}

function showNumbers(run) {
  const shown = [];
  for (const [name, about] of Object.entries(run.streams || {}))
    about.channels.forEach((channel, c) => {
      if (!about.latest.length) return;
      const old = !last.holder || run.end || about.age_s > OLD_S || last.silent_s > OLD_S;
      const [number, units] = readOut(about.latest[c], about.units);
      shown.push({channel, of: name, old, number, units: ` ${units}${old ? " (old)" : ""}`});
    });
  const box = () => {
    const made = element("span");
    made.append(element("span"), element("b"), element("span"));
    return made;
  };
  fill($("numbers"), shown, box, (one, about) => {
    one.dataset.channel = `${about.of}.${about.channel}`;
    one.className = about.old ? "old" : "";
    [`${about.channel} `, about.number, about.units].forEach((text, n) => write(one.children[n], text));
  });
}

function addEvents(news) {
  if (!news.length) return;
  const latest = slips => [...events, ...news].filter(event => (event.level === "slip") === slips).slice(-MOST_EVENTS);
  events = [...latest(false), ...latest(true)]; // many slips push no hold out
  const latestFirst = [...events].sort((a, b) => b.t - a.t || b.n - a.n);
  $("events").replaceChildren(...latestFirst.map(event => {
    const marked = ["warning", "error"].includes(event.level);
    const item = element("li", `${event.t.toFixed(2)} s  ${marked ? event.level + ", " : ""}${event.code}: ${event.text}`);
    item.className = event.level;
    return item;
  }));
}

// --- drawing ------------------------------------------------------------------------------------

const EVENT_COLOURS = {error: "--error", warning: "--warning", slip: "--slip"};
const TITLES = {signals: "PVDF strips", force: "Forces", position: "Positions", servo_error: "Servo error", waveform: "Waveform", load_rate: "Load rate"};
const fits = new ResizeObserver(() => {
  for (const one of Object.values(charts)) {
    const width = Math.max(260, one.box.clientWidth - 10);
    if (one.plot.width !== width) one.plot.setSize({width, height: 210});
  }
});
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function wideEnough(plot, values, axis, cycle) { // for its longest number: one that is cut loses its sign
  const {ticks, gap, font, _size} = plot.axes[axis];
  if (cycle > 1) return _size;
  plot.ctx.font = font[0];
  const widest = Math.max(0, ...(values || []).map(text => plot.ctx.measureText(text ?? "").width));
  return Math.max(58, Math.ceil(ticks.size + gap + widest / devicePixelRatio));
}

function chart(id, title, labels, scales, axes, opts = {}) {
  if (charts[id] && charts[id].named === title + labels) return charts[id];
  if (charts[id]) { charts[id].plot.destroy(); charts[id].box.remove(); }
  const box = element("div", undefined, {class: "chart"});
  box.append(element("h3", title));
  $("charts").append(box);
  const ink = colour("--faint"), grid = {stroke: colour("--grid"), width: 1};
  const plot = new uPlot({
    width: Math.max(260, box.clientWidth - 10), height: 210, scales, pxAlign: 0,
    cursor: {drag: {x: true, y: false}},
    legend: {live: true},
    axes: axes.map(axis => ({stroke: ink, grid, ticks: grid, ...axis})),
    series: [{label: axes[0].label, value: (_, v) => v === null ? "–" : v.toPrecision(6)},
      ...labels.map((label, c) => ({label, stroke: colour("--c" + (opts.points ? 0 : c % 4)), dash: c >= 4 ? [6, 3] : undefined, width: 1, points: {show: !!opts.points, size: c ? 7 : 5, fill: c ? "transparent" : colour("--c0")}, paths: opts.points ? () => null : undefined, value: (_, v) => v === null || v === undefined ? "–" : v.toPrecision(4)}))],
    hooks: opts.events ? {draw: [drawEvents]} : {},
  }, [[], ...labels.map(() => [])], box);
  plot.ctx.canvas.setAttribute("role", "img"); // its values under the cursor are in the legend, a table
  plot.ctx.canvas.setAttribute("aria-label", `Chart: ${title} against ${axes[0].label}, ${labels.join(", ")}`);
  fits.observe(box); // the grid may get a second column with the next chart
  return charts[id] = {plot, box, named: title + labels, drawnWith: [title, labels, scales, axes, opts]};
}

function importance(event) {
  return {"incipient slip": 0, "motion under load begun": 3}[event.code] ?? (["warning", "error"].includes(event.level) ? 1 : 2);
}

function drawEvents(plot) {
  const context = plot.ctx, {left, top, width, height} = plot.bbox, size = 11 * devicePixelRatio;
  const rows = [[], [], []]; // where labels are already, from x to x
  const seen = events.filter(event => event.code !== "discarded" && event.t >= plot.scales.x.min && event.t <= plot.scales.x.max);
  context.save();
  context.textAlign = "left";
  context.font = `${10 * devicePixelRatio}px sans-serif`;
  for (const event of seen.sort((a, b) => importance(a) - importance(b) || a.t - b.t)) {
    const x = plot.valToPos(event.t, "x", true);
    context.strokeStyle = context.fillStyle = colour(EVENT_COLOURS[event.level] || "--faint");
    context.setLineDash(event.code === "incipient slip" ? [] : [4, 3]);
    context.beginPath(); context.moveTo(x, top); context.lineTo(x, top + height); context.stroke();
    const label = event.code.slice(0, 14), wide = context.measureText(label).width;
    const from = x + wide + 3 > left + width ? x - wide - 3 : x + 3, to = from + wide;
    const row = rows.findIndex(taken => taken.every(([a, b]) => to < a - 3 || from > b + 3));
    if (row < 0) continue; // the list below has it
    context.fillText(label, from, top + size * (row + 1));
    rows[row].push([from, to]);
  }
  context.restore();
}

function draw(run) {
  const length = Number($("window").value), newest = run.last_s;
  for (const [name, about] of Object.entries(run.streams || {})) {
    const mine = series[name];
    if (!mine || !mine.k.length) continue;
    const labels = about.channels;
    const one = chart(name, (TITLES[name] || name) + (about.units ? ` (${about.units})` : ""), labels, {x: {time: false}}, [{label: "s since the run's start", labelSize: 18, size: 34}, {size: wideEnough, values: (_, ticks) => ticks.map(v => String(Number(v.toPrecision(6))))}], {events: true});
    const last = mine.k[mine.k.length - 1] * BIN_S;
    const to = Math.max(newest - last > length ? last : newest, length), from = to - length;
    let first = mine.k.length;
    while (first > 0 && mine.k[first - 1] * BIN_S >= from) first--;
    const x = [], y = about.channels.map(() => []);
    for (let i = first; i < mine.k.length; i++) {
      if (i > first && mine.k[i] - mine.k[i - 1] > 20) { // a pause is a gap, not a line
        x.push((mine.k[i - 1] + 1) * BIN_S);
        y.forEach(values => values.push(null));
      }
      x.push(mine.k[i] * BIN_S, (mine.k[i] + 0.5) * BIN_S);
      y.forEach((values, c) => values.push(mine.low[c][i], mine.high[c][i]));
    }
    one.plot.setData([x, ...y], false);
    one.plot.batch(() => { one.plot.setScale("x", {min: from, max: to}); });
  }
  if (run.curve && curve.length) {
    const sorted = curve.filter(point => point[0] !== null && (!run.curve.log || point[0] > 0)).sort((a, b) => a[0] - b[0]);
    const labels = curve.some(point => point[2]) ? [run.curve.y, "invalid (open circles)"] : [run.curve.y];
    const one = chart("curve", run.curve.y, labels, {x: {time: false, distr: run.curve.log ? 3 : 1}}, [{label: run.curve.x, labelSize: 18, size: 34}, {size: wideEnough}], {points: true});
    one.plot.setData([sorted.map(point => point[0]), ...labels.map((_, invalid) => sorted.map(point => point[2] === !!invalid ? point[1] : null))]);
  }
  if (spectrum) {
    const one = chart("spectrum", "Spectrum of " + spectrum.channel, [`${spectrum.channel} (V, peak)`], {x: {time: false, distr: 3}, y: {distr: 3}}, [{label: "Hz", labelSize: 18, size: 34}, {size: wideEnough, values: (_, ticks) => ticks.map(v => v === null ? "" : v.toExponential(0))}]);
    one.plot.setData([spectrum.x, spectrum.y.map(value => Math.max(value, 1e-12))]);
  }
}

function redrawAll() { // with what they show: a view that is paused stays as it was
  const shown = Object.entries(charts);
  charts = {};
  for (const [id, {plot, box, drawnWith}] of shown) {
    const data = plot.data, {min, max} = plot.scales.x;
    plot.destroy();
    box.remove();
    const again = chart(id, ...drawnWith).plot;
    again.batch(() => { again.setData(data, false); again.setScale("x", {min, max}); });
  }
}

function isHeld(frame) {
  return !!(frame.holder || frame.bench_holder);
}

// --- stopping -----------------------------------------------------------------------------------

function showStop() { // of a stop and a "Make safe" what was pressed last
  const course = made && last.stop && made.at > lastFrameAt - 1000 * last.stop.since_s ? null : last.stop;
  const madeSafe = !!made && made.safe && !["UNSAFE", "pressed"].includes(last.word); // it lifts nothing
  $("course").hidden = !course && !made;
  $("course").classList.toggle("safe", course ? course.over && course.safe : madeSafe);
  if (course) {
    say("course-phase", course.phase);
    say("course-age", `(asked at ${course.asked}, ${course.since_s.toFixed(0)} s ago)`);
    say("course-text", course.text);
  } else if (made) {
    say("course-phase", "make safe");
    say("course-age", "");
    say("course-text", made.text);
  }
  document.body.classList.toggle("stopping", !!course && !(course.over && course.safe));
  $("stop").disabled = !last.may_stop;
  $("stop").title = last.may_stop ? "Asks the run to stop safely (key S)" : "This link is view-only.";
}

function object(text) { // a refusal may be plain text
  try { return JSON.parse(text); } catch (error) { return {problem: text}; }
}

async function change(path, body, patience_ms = 4000) {
  const pressed = new Date().toLocaleTimeString("en-GB");
  try {
    const answer = await ask(path, {method: "POST", body: JSON.stringify(body), headers: {"Content-Type": "application/json"}, signal: AbortSignal.timeout(patience_ms)});
    const said = object(await answer.text());
    // It stays until the next press: the time says that it may be of an earlier run.
    notice(said.problem ? `${said.problem} (asked at ${pressed} by this browser's clock)` : "");
    return {ok: answer.ok, ...said};
  } catch (error) {
    notice("The page's server does not answer: end the run at its terminal (Ctrl-C), or press the emergency stop.");
    return {ok: false};
  }
}

async function pressStop() {
  if ($("stop").disabled) return;
  // While a stop is under way a press only counts. One that hangs may be made wider by a choice.
  const stopping = !fresh && last && last.stop && !last.stop.over;
  fresh = false;
  if (night.running && !(stopping && last.stop.phase !== "hanging")) {
    asked = (last && last.run.uuid) || ""; // the dialog may be left open until the next run
    $("ask").showModal();
  } else if (stopping) {
    const said = await change("/api/stop", {what: "again"});
    fresh = !said.ok; // that stop is over, whatever the latest frame says: the next press is a new one
  } else change("/api/stop", {}); // no choice: the server knows whether the run is one of a batch
}

$("stop").addEventListener("click", pressStop);
for (const button of $("ask").querySelectorAll("button"))
  button.addEventListener("click", async () => {
    $("ask").close();
    if (!button.value) return;
    const said = await change("/api/stop", button.value === "run" ? {what: "run", run: asked} : {what: button.value});
    if (said.ok && !said.problem && said.text) notice(said.text);
  });
$("make-safe").addEventListener("click", async () => {
  const at = performance.now();
  made = {at, safe: false, done: false, text: "stopping all motion, switching all outputs off …"};
  if (last) showStop();
  const said = await change("/api/make-safe", {}, 200000);
  const gen = last ? last.gen : -1;
  made = said.ok ? {at, safe: said.exit === 0, done: true, gen, text: `${said.text} (exit ${said.exit})`} : {at, safe: false, done: true, gen, text: said.problem || "no answer"};
  if (last) showStop();
});
addEventListener("keydown", event => {
  // In a list S is STOP as well: what was chosen there keeps the focus.
  const typing = /^(INPUT|TEXTAREA)$/.test(document.activeElement?.tagName || "");
  if (event.key.toLowerCase() !== "s" || event.ctrlKey || event.altKey || event.metaKey || event.repeat || typing) return;
  event.preventDefault();
  if ($("ask").open) $("ask").querySelector("[value=night]").click();
  else pressStop();
});

// --- the night ----------------------------------------------------------------------------------

async function single(what, read) { // one at a time: a browser has few connections, of which STOP needs one
  if (reading[what]) return;
  reading[what] = true;
  try { await read(); } finally { reading[what] = false; }
}

function readNight() {
  return single("night", async () => {
    let why = "";
    try {
      const answer = await ask("/api/night", {signal: AbortSignal.timeout(1000 * NIGHT_OLD_S)});
      if (answer.ok) {
        night = await answer.json();
        if (night.age_s > NIGHT_OLD_S) why = "the batch's folder gives no answer";
        else nightAt = new Date().toLocaleTimeString("en-GB");
      } else why = `the page's server answered with an error (${answer.status})`;
    } catch (error) { why = "the page's server gave no answer"; }
    nightOld = why && `This view is old${nightAt && `, of ${nightAt} by this browser's clock`}: ${why}.`;
    if (tab === "night") showNight();
  });
}

function table(of, heads, rows) {
  const made = element("table"), head = element("tr");
  heads.forEach(name => head.append(element("th", name)));
  made.append(element("thead"), element("tbody"));
  made.tHead.append(head);
  for (const row of rows) {
    const line = element("tr");
    row.forEach(value => line.append(element("td", value, {class: String(value).length > 30 ? "text" : ""})));
    made.tBodies[0].append(line);
  }
  const wide = element("div", undefined, {class: "wide", "data-of": of});
  wide.append(made);
  return wide;
}

function total(runs) {
  return Object.values(runs).reduce((a, b) => a + b, 0);
}

function ended(runs) { // those that are not repeated
  return runs.done + runs.failed + runs["set-aside"];
}

function showNight() {
  const body = $("night-body");
  const parts = nightOld ? [element("p", nightOld, {class: "warning"})] : [];
  if (night.problem) return body.replaceChildren(...parts, element("p", night.problem, {class: "warning"}));
  if (!night.name) return body.replaceChildren(...(nightOld ? parts : [element("p", "There is no batch in this folder.")]));
  for (const text of night.bench_warnings) parts.push(element("p", text, {class: "warning"}));
  parts.push(element("h2", `${night.simulated ? "SIMULATED " : ""}batch ${night.name}: ${night.state}${night.running ? "" : " (not running)"}`));
  parts.push(element("progress", undefined, {max: total(night.runs), value: ended(night.runs)}));
  const list = element("dl");
  const facts = [["done", `${night.runs.done} of ${total(night.runs)}`], ["queued", night.runs.queued], ["running", night.runs.running], ["failed", night.runs.failed], ["left out", night.runs["set-aside"]], ["done, with invalid points", night.runs_with_invalid_points], ["retried", night.retried], ["holds", night.holds], ["presses", night.presses], ["time left", span(night.left_s)], ["expected end", night.running && !night.simulated ? when(night.finish) : "–"]];
  if (night.heartbeat) facts.push(["now", `${night.heartbeat.state}: ${night.heartbeat.message}`]);
  for (const [name, value] of facts) {
    const pair = element("div");
    pair.append(element("dt", name), element("dd", value));
    list.append(pair);
  }
  parts.push(list);
  for (const drift of night.drift) {
    parts.push(element("h2", `Reference ${drift.condition}: ${drift.figure}, change since run ${drift.runs[0]} (tolerance ${`${drift.tolerance} ${drift.unit}`.trim()})`));
    parts.push(table(`${drift.condition} ${drift.key}`, ["run", ...drift.runs.slice(-12)], [[drift.key, ...drift.change.slice(-12).map(value => value.toFixed(3))]]));
  }
  for (const [name, rows] of Object.entries(night.lists)) {
    if (!rows.length) continue;
    parts.push(element("h2", `${name.replace("_", " ")} (${rows.length}${rows.length === 200 ? " shown" : ""})`));
    parts.push(table(name, ["run", "condition", "points", "attempts", "time", "reason"], rows.map(row => [row.run, row.condition, row.points, row.attempts, row.bench_s ? span(row.bench_s) : "", row.reason])));
  }
  if (night.events.length) {
    parts.push(element("h2", "Latest events"));
    parts.push(table("events", ["time", "level", "text"], night.events.map(event => [when(event.time), event.level, event.text])));
  }
  const tables = () => [...body.querySelectorAll(".wide")];
  const scrolled = new Map(tables().map(one => [one.dataset.of, [one.scrollLeft, one.scrollTop]]));
  body.replaceChildren(...parts);
  for (const one of tables()) one.scrollTo(...(scrolled.get(one.dataset.of) || [0, 0])); // what is being read stays
}

// --- history ------------------------------------------------------------------------------------

async function readHistory() {
  const form = new FormData($("filters"));
  let found;
  try {
    const answer = await ask("/api/runs?" + new URLSearchParams(form));
    if (!answer.ok) return;
    const text = await answer.text();
    if (text === listed) return; // the rows stay, and with them what has the keyboard's focus
    listed = text;
    found = JSON.parse(text);
  } catch (error) { return; }
  $("count").textContent = `${found.matching} of ${found.of} runs${found.complete ? "" : ", still reading …"}${found.matching > found.runs.length ? `, the latest ${found.runs.length} shown` : ""}`;
  const select = $("filters").elements.procedure;
  for (const name of found.procedures)
    if (name && ![...select.options].some(option => option.value === name)) select.append(element("option", name, {value: name}));
  $("runs").tBodies[0].replaceChildren(...found.runs.map(run => {
    const line = element("tr", undefined, {tabindex: "0", "data-run": run.id, "aria-selected": String(run.id === chosen)});
    const start = run.start ? when(run.start) : run.name;
    const outcome = run.status + (run.exit ? `, exit ${run.exit}` : "");
    for (const value of [start, run.procedure, run.sample, outcome, run.points, run.duration_s === null ? "" : span(run.duration_s), run.mark]) line.append(element("td", value));
    line.addEventListener("click", () => showRun(run.id));
    line.addEventListener("keydown", event => { if (event.key === "Enter") showRun(run.id); });
    return line;
  }));
}

async function showRun(id) {
  chosen = id;
  for (const line of $("runs").tBodies[0].rows) line.setAttribute("aria-selected", String(line.dataset.run === id));
  const answer = await ask("/api/runs/" + encodeURIComponent(id));
  if (!answer.ok) return notice("this run is no longer in the folder");
  const run = await answer.json();
  if (chosen !== id) return; // another one was chosen meanwhile
  const parts = [element("h2", run.summary ? run.summary.title : run.name)];
  if (run.problem) parts.push(element("p", run.problem, {class: "warning"}));
  const files = element("div", undefined, {class: "files"});
  const stem = run.name.replace(/\.[^.]*$/, "");
  for (const file of run.files) { // the rest of its name says which it is
    const rest = file.name.startsWith(stem) ? file.name.slice(stem.length).replace(/^[-.]/, "") : file.name;
    const size = file.bytes < 1024 ? `${file.bytes} B` : `${(file.bytes / 1024).toFixed(0)} kB`;
    const button = element("button", `${rest} (${size})`, {type: "button", title: file.name});
    button.addEventListener("click", () => download(id, file.name));
    files.append(button);
  }
  parts.push(files);
  for (const file of run.files.filter(file => file.name.endsWith(".png"))) {
    const picture = element("img", undefined, {alt: file.name});
    picture.addEventListener("load", () => URL.revokeObjectURL(picture.src)); // else each stays in memory
    blobOf(id, file.name).then(url => { if (url) picture.src = url; });
    parts.push(picture);
  }
  for (const found of run.processed || []) parts.push(element("h2", `Detector ${found.detector} ${found.version}`), element("pre", Object.entries(found.trials).map(([trial, events]) => `${trial}: ${events.join("; ")}`).join("\n")));
  if (run.summary) parts.push(element("h2", "Summary"), element("pre", lines(run.summary)));
  $("detail").replaceChildren(...parts);
  $("detail").hidden = false;
  $("detail").style.scrollMarginTop = `${$("top").offsetHeight + 8}px`; // the state stays above it
  $("detail").scrollIntoView({behavior: "smooth"});
}

function lines(value, indent = "") {
  return Object.entries(value).map(([key, item]) => {
    if (!item || typeof item !== "object") return `${indent}${key}: ${item ?? "none"}`;
    if (!Array.isArray(item)) return `${indent}${key}:\n${lines(item, indent + "  ")}`;
    const texts = item.map(one => typeof one === "string" ? one : JSON.stringify(one));
    const each = item.some(one => typeof one === "string"); // a line for each warning
    return each ? `${indent}${key}:\n${texts.map(text => `${indent}  ${text}`).join("\n")}` : `${indent}${key}: ${texts.join(", ")}`;
  }).join("\n");
}

async function blobOf(id, name) {
  const answer = await ask(`/api/runs/${encodeURIComponent(id)}/${encodeURIComponent(name)}`);
  return answer.ok ? URL.createObjectURL(await answer.blob()) : null;
}

async function download(id, name) {
  const url = await blobOf(id, name);
  if (!url) return notice(`${name} is no longer available`);
  const link = element("a", undefined, {href: url, download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

// --- the rest -----------------------------------------------------------------------------------

for (const button of document.querySelectorAll("nav button"))
  button.addEventListener("click", () => {
    tab = button.dataset.tab;
    for (const other of document.querySelectorAll("nav button")) {
      other.setAttribute("aria-selected", String(other === button));
      $(other.dataset.tab).hidden = other !== button;
    }
    if (tab === "night") readNight();
    else if (tab === "history") readHistory();
    else if (last) show();
  });
$("pause").addEventListener("click", () => {
  paused = !paused;
  $("pause").setAttribute("aria-pressed", String(paused));
  $("pause").textContent = paused ? "Continue the view" : "Pause the view";
  if (!paused && last) show();
});
$("filters").addEventListener("input", readHistory);
$("filters").addEventListener("submit", event => { event.preventDefault(); readHistory(); });
$("window").addEventListener("change", () => { if (last) show(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
addEventListener("unhandledrejection", event => notice(`The page failed: ${event.reason}. Reload it.`));
setInterval(showWord, 500);
setInterval(readNight, 5000);
setInterval(() => { if (tab === "history") single("history", readHistory); }, 5000);
$("stop").disabled = false; // until the first frame says who may stop
readNight();
watch();
