// The runs on this disk: the list, and one of them.

import * as charts from "./charts.js";
import { ask, facts, fill, guarded, liveLink, make, number, open, runLink, say, score, tiles } from "./dom.js";

const COLUMNS = [
  ["run", "run"], ["created", "begun"], ["task", "task"], ["generations", "generations"], ["mean", "last average"],
  ["best", "best evaluation"], ["confirmed", "confirmed"], ["state", "state"],
];
const NUMBERS = new Set(["generations", "mean", "best", "confirmed"]);
let order = { by: "created", down: true };
let sought = "";
let chosen = []; // names of two runs at most, the last two that were ticked

export const showRuns = guarded(async (current) => {
  document.title = "dreamfleet: runs";
  const page = open("runs");
  const load = async () => {
    const found = await ask("runs");
    if (!current()) return;
    say(page.folder, `in ${found.folder}`);
    const names = new Set(found.runs.map((each) => each.run));
    chosen = chosen.filter((each) => names.has(each));
    list(page, found.runs);
  };
  page.reload.addEventListener("click", () => current() && showRuns());
  page.compare.addEventListener("click", () => {
    location.hash = `#/compare/${chosen.map(encodeURIComponent).join("/")}`;
  });
  page.search.value = sought;
  await load();
});

const list = (page, runs) => {
  const again = () => list(page, runs);
  page.search.oninput = () => {
    sought = page.search.value;
    again();
  };
  fill(page.head, [["pick", ""], ...COLUMNS], () => make("th", "", { scope: "col" }), (head, [key, label]) => {
    if (key === "pick") {
      if (!head.firstChild) head.append(make("span", "pick", { title: "Tick two runs to compare them" }));
      return;
    }
    if (!head.firstChild) {
      head.append(make("button", label, { type: "button" }));
      if (NUMBERS.has(key)) head.classList.add("n");
      head.firstChild.addEventListener("click", () => {
        order = { by: key, down: order.by === key ? !order.down : NUMBERS.has(key) || key === "created" };
        head.parentElement.again();
      });
    }
    if (order.by === key) head.setAttribute("aria-sort", order.down ? "descending" : "ascending");
    else head.removeAttribute("aria-sort");
  });
  page.head.again = again;
  const words = sought.toLowerCase().split(/\s+/).filter(Boolean);
  const shown = runs.filter((each) => words.every((word) => `${each.run} ${each.task ?? ""} ${each.state}`.toLowerCase().includes(word)));
  shown.sort(compareBy(order));
  page.rows.replaceChildren(...shown.map((each) => runRow(each, page)));
  page.none.hidden = shown.length > 0;
  say(page.none, runs.length ? "No run has these words." : "No runs here yet. Start one with: dreamfleet coordinator --run NAME");
  page.compare.disabled = chosen.length !== 2;
};

// What is not known stands last, whichever way is sorted.
const compareBy = ({ by, down }) => (one, other) => {
  const [a, b] = [one[by], other[by]];
  const missing = (value) => value === null || value === undefined;
  if (missing(a) || missing(b)) return missing(a) - missing(b) || one.run.localeCompare(other.run);
  const found = typeof a === "number" ? a - b : String(a).localeCompare(String(b));
  return (down ? -found : found) || one.run.localeCompare(other.run);
};

const runRow = (each, page) => {
  const row = make("tr");
  if (each.damaged) row.dataset.damaged = "";
  const pick = make("td", "", { class: "pick" });
  const box = make("input", "", { type: "checkbox", "aria-label": `compare ${each.run}` });
  box.checked = chosen.includes(each.run);
  box.disabled = each.damaged;
  box.addEventListener("change", () => {
    chosen = chosen.filter((name) => name !== each.run);
    if (box.checked) chosen = [...chosen, each.run].slice(-2);
    for (const other of page.rows.querySelectorAll("input")) other.checked = chosen.includes(other.run);
    page.compare.disabled = chosen.length !== 2;
  });
  box.run = each.run;
  pick.append(box);
  row.append(pick);
  for (const [key, label] of COLUMNS) {
    const kind = key === "run" ? "name" : key === "state" ? "says" : NUMBERS.has(key) ? "n" : "";
    const cell = make("td", "", { class: `${kind} col-${key}` });
    if (key === "run" && !each.damaged) cell.append(make("a", each.run, { href: each.state === "live" ? liveLink(each.run) : runLink(each.run) }));
    else say(cell, describe(each, key));
    if (key !== "run" && key !== "state") cell.dataset.label = label;
    row.append(cell);
  }
  return row;
};

const describe = (each, key) => {
  if (key === "created") return each.begun ?? "";
  const error = each[`${key}_error`];
  if (typeof error === "number") return withError(each[key], error);
  if (key === "generations") return number(each.generations, 0);
  return NUMBERS.has(key) ? score(each[key]) : (each[key] ?? "");
};

// As many decimals as show the first figure of a small error. Counts alike: common/runs/standard_error.py.
const withError = (mean, error) => {
  if (error < 1e-6 || Math.abs(mean) >= 1e12) return `${score(mean)} ± ${score(error)}`;
  const digits = error > 0 && error < 0.1 ? Math.min(6, -Math.floor(Math.log10(error))) : 1;
  return `${number(mean, digits)} ± ${number(error, digits)}`;
};

export const showRun = guarded(async (current, name) => {
  document.title = `${name}: past run`;
  const found = await ask(`runs/${encodeURIComponent(name)}`);
  if (!current()) return;
  const page = open("run");
  say(page.run, found.run);
  say(page.state, found.state);
  page.state.dataset.tone = found.ended ? "done" : found.state === "live" ? "good" : "wait";
  page.again.hidden = !found.again;
  say(page.again.lastElementChild, found.again);
  page.live.hidden = found.state !== "live";
  page.live.href = liveLink(found.run);
  page.hosts.href = `#/hosts/${encodeURIComponent(found.run)}`;
  tiles(page.tiles, found.tiles);
  facts(page.facts, found.facts);
  fillSettings(page, found.settings);
  fillCurves(page, found);
  charts.fillArchive(page, found);
  fillGenerations(page, found.generations);
  const others = (await ask("runs")).runs.filter((each) => !each.damaged && each.run !== found.run);
  if (!current()) return;
  page.other.replaceChildren(make("option", "choose a run", { value: "" }), ...others.map((each) => make("option", each.run)));
  page.other.addEventListener("change", () => {
    if (page.other.value) location.hash = `#/compare/${encodeURIComponent(found.run)}/${encodeURIComponent(page.other.value)}`;
  });
});

const fillCurves = (page, { run, curves }) => {
  const none = curves.generation.length ? "" : "No generation was closed, so there is nothing to draw.";
  charts.placeholder(page.fitness, none);
  charts.placeholder(page.search, none);
  if (none) return;
  charts.fitness(page.fitness, curves);
  charts.search(page.search, curves);
  say(page["fitness-title"], charts.title(curves));
  say(page["fitness-caption"], charts.caption(curves));
  page.fitness.setAttribute("aria-label", `${charts.title(curves)} of ${run} by generation`);
  page.search.setAttribute("aria-label", `Step size of ${run} by generation`);
};

const fillSettings = (page, settings) => {
  const rows = settings.map(([name, value, differs]) => {
    const row = make("tr", "", { role: "row", class: differs ? "differs" : "" }); // the roles that a grid would take from a table
    row.append(make("th", name, { scope: "row", role: "rowheader" }), make("td", value, { role: "cell" }));
    row.words = `${name} ${value}`.toLowerCase();
    return row;
  });
  page.settings.replaceChildren(...rows);
  page["settings-search"].addEventListener("input", () => {
    const words = page["settings-search"].value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of rows) row.hidden = !words.every((word) => row.words.includes(word));
    page["no-settings"].hidden = rows.some((row) => !row.hidden);
  });
};

const fillGenerations = (page, generations) => {
  const hasFailed = generations.some((each) => each.failed);
  page.failed.hidden = !hasFailed;
  page["last-table"].hidden = !generations.length;
  page.generations.replaceChildren(...generations.map((each) => {
    const row = make("tr");
    const texts = [
      number(each.generation, 0), score(each.mean), score(each.std), score(each.best), score(each.worst),
      each.sigma.toPrecision(4), ...(hasFailed ? [number(each.failed ?? 0, 0)] : []), number(each.steps, 0), number(each.seconds),
    ];
    row.append(...texts.map((text, at) => make("td", text, { class: at === 2 || at === 4 || at > 5 ? "n wide-only" : "n" })));
    return row;
  }));
};
