// The page of a live run: a frame a second fills it, and curves are drawn anew when a generation was closed.

import * as charts from "./charts.js";
import { ask, clock, colour, facts, fill, make, number, open, runLink, say, score, tiles } from "./dom.js";
import * as view from "./view.js";

const TONES = { // by the words of run/shown_state.py
  running: "good", evaluating: "busy", paused: "bad", "waiting for workers": "wait", "waiting for a batch": "wait", "coordinator lost": "bad",
  ended: "done", "left open": "wait", "no coordinator": "wait",
};
const COLUMNS = [
  ["state", "state"], ["slots", "slots"], ["rate", "steps/s"], ["leases", "assigned"], ["finished", "finished"],
  ["load", "load"], ["heard", "last seen"], ["picture", "picture"],
];
const MANY = 100; // workers from which on those out of sight are filled anew only every fifth time, which saves half the work
const LEFT = new Set(["state", "picture"]);

let page = null; // the parts, once they stand
let curves = null;
let sight = null; // an observer of rows: which are seen
let turns = 0; // frames that filled the table of workers
let absent = null; // the run that was asked for, or "" for any, while none is live

export const show = () => {
  page = open("live");
  page.body.hidden = page.tiles.hidden = true;
  view.show(page);
  curves = absent = null;
  sight?.disconnect();
  sight = new IntersectionObserver((seen) => {
    for (const each of seen) each.target.inSight = each.isIntersecting;
  });
  say(page.run, "dreamfleet");
  say(page.sentence, "Asking the coordinator…");
  page.state.hidden = true;
};

export const drawCurves = (document) => {
  curves = document;
  if (page) view.drawCurves(curves);
  if (!page || page.body.hidden) return;
  const last = curves.generation.length - 1;
  say(page["fitness-title"], charts.title(curves));
  charts.placeholder(page.fitness, last < 0 ? curves.coming : "");
  page.search.hidden = last < 0; // the figures below it are known from the start
  if (last < 0) return;
  charts.fitness(page.fitness, curves);
  charts.search(page.search, curves);
  charts.fillArchive(page, { ...curves, run: page.run.textContent });
  say(page["fitness-caption"], charts.caption(curves));
  page.fitness.setAttribute("aria-label", `${charts.title(curves)} by generation. Generation ${curves.generation[last]}: mean ${score(curves.mean[last])}, best ${score(curves.best[last])}.`);
  page.search.setAttribute("aria-label", `Step size by generation, now ${curves.sigma[last]}`);
};

export const fillFrame = (frame, wanted) => {
  if (!page) return;
  page.state.hidden = false;
  choose(frame, wanted);
  if (frame.link === "absent") return fillAbsent(frame, wanted);
  const ended = frame.link === "over" && frame.stored && frame.state === "ended";
  if (ended && wanted) return location.replace(runLink(wanted)); // without a name the page waits for the next run
  absent = null;
  const first = page.body.hidden;
  page.body.hidden = page.tiles.hidden = false;
  document.title = `${frame.run}: ${frame.state}`;
  say(page.run, frame.run);
  say(page.state, frame.lost ? `${frame.state} since ${clock(frame.lost)}` : frame.state);
  page.state.dataset.tone = TONES[frame.state] ?? "done";
  say(page.sentence, frame.sentence);
  page.result.hidden = !frame.stored;
  page.result.href = runLink(frame.run);
  say(page.result, ended ? "Its result" : "Settings and generations");
  page.history.hidden = !frame.stored;
  page.history.href = `#/hosts/${encodeURIComponent(frame.run)}`;
  say(page.eta, frame.eta ? frame.eta.text : "");
  fill(page.bounds, frame.eta ? frame.eta.bounds : [], () => bar(), (each, row) => setBar(each, row.share, row.text));
  say(page.task, frame.task);
  tiles(page.tiles, frame.tiles);
  page.troubles.hidden = !frame.troubles.length;
  fill(page.troubles, frame.troubles, () => make("li"), say);
  fillPopulation(frame);
  facts(page["search-facts"], frame.search);
  say(page.redundant, frame.redundant.text);
  facts(page["redundant-facts"], frame.redundant.rows);
  say(page.fleet, frame.fleet);
  fillWorkers(frame);
  view.fill(frame);
  if (first && curves) drawCurves(curves);
};

const fillAbsent = (frame, wanted) => {
  view.fill(frame);
  page.body.hidden = page.tiles.hidden = true;
  page.troubles.hidden = !frame.trouble;
  fill(page.troubles, frame.trouble ? [frame.trouble] : [], () => make("li"), say);
  const run = wanted || frame.only;
  document.title = "dreamfleet: no live run";
  say(page.run, run || "No live run");
  say(page.state, "no coordinator");
  page.state.dataset.tone = TONES["no coordinator"];
  say(page.sentence, `No coordinator ${run ? `of ${run} ` : ""}answers at ${frame.address}. This page shows it as soon as one does.`);
  fill(page.bounds, [], make, say);
  say(page.eta, "");
  if (absent === run) return;
  absent = run;
  page.task.replaceChildren();
  page.result.hidden = page.history.hidden = true;
  const parts = page;
  const mine = () => page === parts && absent === run;
  ask("runs").then(({ runs }) => mine() && page.task.replaceChildren(...ways(frame, run, runs, wanted)), () => mine() && page.task.replaceChildren(...ways(frame, run, [], wanted)));
};

// What there is to do about a run that nobody serves: go on with what lies here, look at its result, or begin one.
const ways = (frame, run, runs, wanted) => {
  const stored = run ? runs.find((each) => each.run === run && !each.damaged) : latestOf(runs.filter((each) => each.again));
  const past = make("a", "all runs", { href: "#/runs" });
  if (!stored) return ["Start one: ", make("code", `dreamfleet coordinator --run ${run || "NAME"} --listen ${frame.address.split(",")[0]}`), ". Or look at ", past, "."];
  const link = make("a", stored.run, { href: runLink(stored.run) });
  if (wanted && stored.ended) location.replace(runLink(stored.run)); // its address leads to its result
  if (!stored.again) return ["Run ", link, ` lies here, ${stored.state}. Or look at `, past, "."];
  return ["Run ", link, " was left open here. Continue it: ", make("code", stored.again), ". If it had a join file, add ", make("code", "--join FILE"), ". Or look at ", past, "."];
};

const latestOf = (runs) => runs.reduce((one, other) => (one && one.created > other.created ? one : other), undefined);

// Where several runs are live, one of them.
const choose = (frame, wanted) => {
  const names = frame.live.length > 1 || (wanted && frame.live.length && !frame.live.includes(wanted)) ? frame.live : [];
  page.chooser.hidden = !names.length;
  fill(page.chooser, names, () => make("a"), (each, name) => {
    say(each, name);
    each.setAttribute("href", `#/live/${encodeURIComponent(name)}`);
    if (name === frame.run) each.setAttribute("aria-current", "true");
    else each.removeAttribute("aria-current");
  });
};

const bar = () => {
  const whole = make("div", "", { class: "bound", role: "progressbar", "aria-valuemin": "0", "aria-valuemax": "100" });
  whole.append(make("i"));
  return whole;
};

const setBar = (element, share, text) => {
  element.title = text;
  element.setAttribute("aria-label", text);
  element.setAttribute("aria-valuenow", String(Math.round(100 * share)));
  element.firstChild.style.width = `${100 * share}%`;
};

const CELLS = [[400, 9], [120, 14], [64, 22], [32, 30], [12, 40], [-1, 56]]; // of more candidates than this, so wide

// A cell a candidate: it fills with its episodes, and its colour says how it does among the others. No episode is wanted of
// a candidate that failed: its cell is crossed out.
const fillPopulation = ({ candidates, evaluation }) => {
  const { generation, total, done, wanted, fitness, word, minimised } = candidates;
  const known = fitness.filter((each) => each !== null);
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const failed = wanted.filter((each) => each === 0).length; // counts alike: common/client/status.py
  const finished = done.filter((each, index) => each >= wanted[index]).length - failed;
  const rest = total > done.length ? `, the first ${done.length} are shown` : "";
  const open = total > 0;
  say(page["population-text"], open ? `Generation ${generation}: ${finished} of ${total} candidates are scored${failed ? `, ${failed} failed` : ""}${rest}.` : "No generation is open.");
  page.cells.style.setProperty("--cell", `${CELLS.find(([least]) => total > least)[1]}px`);
  fill(page.cells, done, () => make("div", "", { class: "cell" }), (cell, episodes, index) => {
    const value = fitness[index];
    const share = value === null ? 0 : high > low ? (minimised ? high - value : value - low) / (high - low) : 1;
    const key = `${episodes}/${wanted[index]}/${value === null ? "" : share.toFixed(2)}`;
    const lost = wanted[index] === 0;
    const scored = `${episodes} of ${wanted[index]} episodes${value === null ? "" : `, ${word} ${score(value)}`}`;
    const text = `candidate ${generation}/${index}: ${lost ? "failed" : scored}`;
    if (cell.described !== text) cell.title = cell.described = text;
    if (cell.key === key) return;
    cell.key = key;
    cell.classList.toggle("failed", lost);
    cell.style.setProperty("--done", wanted[index] ? `${(100 * episodes) / wanted[index]}%` : "0%");
    cell.style.setProperty("--fill", value === null ? "var(--line-strong)" : shade(share));
  });
  page.cells.setAttribute("aria-label", open ? `${finished} of ${total} candidates of generation ${generation} are scored` : "no generation is open");
  say(page.scale, known.length ? `${word} so far: ${score(low)} to ${score(high)}` : "");
  fill(page.evaluation, evaluation, () => make("p"), say);
};

const shade = (share) =>
  share < 0.5
    ? `hsl(${214 - 48 * share} ${45 + 20 * share}% ${72 - 48 * share}%)`
    : `hsl(${190 - 100 * (share - 0.5)} ${55 + 10 * (share - 0.5)}% ${48 - 24 * (share - 0.5)}%)`;

const fillWorkers = (frame) => {
  const { workers } = frame;
  const count = workers.worker.length;
  page["no-workers"].hidden = count > 0;
  say(page["worker-command"], `dreamfleet worker --run ${frame.run} --connect tcp/COORDINATOR:7447`);
  const fleet = page.workers;
  while (fleet.children.length > count) {
    sight.unobserve(fleet.lastElementChild);
    fleet.lastElementChild.remove();
  }
  fleet.parentElement.classList.toggle("undrawn", workers.picture.every((each) => each === "-"));
  const all = count < MANY || turns % 5 === 0;
  turns += 1;
  let before = "";
  const inks = laneInks(); // read once: between changes of the page each reading would cost a layout of it
  for (let index = 0; index < count; index += 1) {
    if (!fleet.children[index]) {
      fleet.append(workerRow());
      sight.observe(fleet.lastElementChild);
    }
    const row = fleet.children[index];
    const [host, life] = split(workers.worker[index]);
    const who = `${workers.worker[index]} ${workers.state[index]}`;
    if (!all && !row.inSight && row.who === who) {
      before = host;
      continue;
    }
    row.who = who;
    row.dataset.state = workers.state[index];
    row.classList.toggle("same", host === before);
    before = host;
    say(row.name.firstChild, host);
    say(row.name.lastChild, workers.reason[index] ? `${life} ${workers.reason[index]}` : life);
    if (row.lane !== workers.lane[index]) {
      row.lane = workers.lane[index];
      paintLane(row, inks);
    }
    COLUMNS.forEach(([key], at) => say(row.cells[at + 2], cell(key, workers[key][index])));
  }
};

const split = (worker) => {
  const at = worker.indexOf("/"); // counts alike: common/protocol/keys.py
  return at < 0 ? [worker, ""] : [worker.slice(0, at), worker.slice(at)];
};

const cell = (key, value) =>
  value === null ? "-" : key === "heard" ? ago(value) : key === "load" ? value.toFixed(2) : typeof value === "number" ? value.toLocaleString("en") : value;

const ago = (seconds) => (seconds < 99.95 ? `${seconds.toFixed(1)} s ago` : `${Math.round(seconds / 60)} min ago`);

const workerRow = () => {
  const row = make("tr", "", { role: "row" }); // the roles that a grid would take from a table
  row.name = make("td", "", { class: "name", role: "cell" });
  row.name.append(make("b"), make("small"));
  const lane = make("td", "", { class: "lane", role: "cell" });
  row.canvas = make("canvas", "", { width: "480", height: "32", "aria-hidden": "true" });
  lane.append(row.canvas);
  row.append(row.name, lane);
  for (const [key, label] of COLUMNS)
    row.append(make("td", "", { "data-label": label, role: "cell", class: key === "state" ? "tag" : LEFT.has(key) ? "" : "n" }));
  return row;
};

const laneInks = () => ({
  x: colour("red"), "?": colour("amber"), ".": colour("line-strong"), " ": colour("soft"), speed: colour("blue"),
});

// Only what changed since it was painted last: of a lane mostly its newest slice.
const paintLane = (row, inks) => {
  const { canvas, lane, painted = "" } = row;
  const paper = canvas.getContext("2d");
  const wide = canvas.width / lane.length;
  for (let at = 0; at < lane.length; at += 1) {
    const sign = lane[at];
    if (sign === painted[at]) continue;
    const last = sign === " " ? wide : wide - 1; // a gap between slices
    paper.globalAlpha = 1;
    paper.fillStyle = inks[" "];
    paper.fillRect(at * wide, 0, wide, canvas.height);
    if (!inks[sign]) paper.globalAlpha = 0.25 + 0.75 * (Number(sign) / 9);
    paper.fillStyle = inks[sign] ?? inks.speed;
    paper.fillRect(at * wide, 0, last, canvas.height);
  }
  row.painted = lane;
};

export const redraw = () => {
  if (!page) return;
  const inks = laneInks();
  for (const row of page.workers.children) {
    row.painted = "";
    paintLane(row, inks);
  }
};

export const leave = () => {
  view.leave();
  sight?.disconnect();
  page = null;
};
