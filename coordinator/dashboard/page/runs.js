// Past runs: the list, one of them, and two on one chart.

import * as charts from "./charts.js";
import { ask, facts, fill, make, number, open, runLink, say } from "./dom.js";

const COLUMNS = [
  ["run", "run"], ["created", "begun"], ["task", "task"], ["generations", "generations"], ["mean", "last mean"],
  ["best", "best evaluation"], ["confirmed", "confirmed"], ["state", "state"],
];
const NUMBERS = new Set(["generations", "mean", "best", "confirmed"]);
let order = { by: "created", down: true };
let sought = "";
let chosen = []; // names of two runs at most, the last two that were ticked
let turn = 0; // an answer that comes after another page was opened is nobody's

const failed = (error) => {
  const root = document.getElementById("main");
  const card = make("section", "", { class: "card full empty" });
  card.append(make("h1", "This cannot be shown"), make("p", error.message), make("a", "All runs", { href: "#/runs" }));
  root.replaceChildren(card);
};

const guarded = (work) => async (...words) => {
  turn += 1;
  const mine = turn;
  try {
    await work(() => mine === turn, ...words);
  } catch (error) {
    if (mine === turn) failed(error);
  }
};

export const leave = () => {
  turn += 1;
};

export const showRuns = guarded(async (current) => {
  document.title = "dreamfleet: past runs";
  const page = open("runs");
  const load = async () => {
    const found = await ask("runs");
    if (!current()) return;
    say(page.folder, `in ${found.folder}`);
    const names = new Set(found.runs.map((each) => each.run));
    chosen = chosen.filter((each) => names.has(each));
    list(page, found.runs);
  };
  page.reload.addEventListener("click", () => load().catch((error) => current() && failed(error)));
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
      if (!head.firstChild) head.append(make("span", "two", { title: "Tick two runs to compare them" }));
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
    const cell = make("td", "", { class: kind });
    if (key === "run" && !each.damaged) cell.append(make("a", each.run, { href: runLink(each.run) }));
    else say(cell, describe(each, key));
    if (key !== "run" && key !== "state") cell.dataset.label = label;
    row.append(cell);
  }
  return row;
};

const describe = (each, key) => {
  if (key === "created") return each.begun ?? "";
  const error = each[`${key}_error`];
  if (typeof error === "number") return `${number(each[key])} ± ${number(error)}`;
  if (key === "generations") return number(each.generations, 0);
  return NUMBERS.has(key) ? number(each[key]) : (each[key] ?? "");
};

export const showRun = guarded(async (current, name) => {
  document.title = `${name}: past run`;
  const found = await ask(`runs/${encodeURIComponent(name)}`);
  if (!current()) return;
  const page = open("run");
  say(page.run, found.run);
  say(page.state, found.state.startsWith("ended") ? "ended" : found.state);
  page.state.dataset.tone = found.state.startsWith("ended") ? "done" : found.state === "live" ? "good" : "wait";
  say(page.sentence, found.sentence);
  page.again.hidden = !found.again;
  say(page.again.lastElementChild, found.again);
  facts(page.facts, found.facts);
  facts(page.settings, found.settings);
  const { curves } = found;
  charts.fitness(page.fitness, curves);
  charts.search(page.search, curves);
  const every = curves.step > 1 ? `Every ${curves.step}th generation is drawn.` : "";
  say(page["fitness-caption"], curves.generation.length ? every : "No generation was closed.");
  page.fitness.setAttribute("aria-label", `Fitness of ${found.run} by generation`);
  page.search.setAttribute("aria-label", `Step size of ${found.run} by generation`);
  page.generations.replaceChildren(...found.generations.map(generationRow));
  const others = (await ask("runs")).runs.filter((each) => !each.damaged && each.run !== found.run);
  if (!current()) return;
  page.other.replaceChildren(make("option", "choose a run", { value: "" }), ...others.map((each) => make("option", each.run)));
  page.other.addEventListener("change", () => {
    if (page.other.value) location.hash = `#/compare/${encodeURIComponent(found.run)}/${encodeURIComponent(page.other.value)}`;
  });
});

const generationRow = (each) => {
  const row = make("tr");
  const texts = [
    number(each.generation, 0), number(each.mean), number(each.std), number(each.best), number(each.worst),
    each.sigma.toPrecision(4), each.failed ? number(each.failed, 0) : "", number(each.steps, 0), number(each.seconds),
  ];
  row.append(...texts.map((text) => make("td", text, { class: "n" })));
  return row;
};

export const showCompare = guarded(async (current, one, other) => {
  document.title = `${one} and ${other}`;
  const runs = await Promise.all([one, other].map((name) => ask(`runs/${encodeURIComponent(name)}`)));
  const names = (await ask("runs")).runs.filter((each) => !each.damaged).map((each) => each.run);
  if (!current()) return;
  const page = open("compare");
  [page.a, page.b].forEach((select, index) => {
    select.replaceChildren(...names.map((name) => make("option", name)));
    select.value = runs[index].run;
    select.addEventListener("change", () => {
      location.hash = `#/compare/${encodeURIComponent(page.a.value)}/${encodeURIComponent(page.b.value)}`;
    });
  });
  const evaluated = runs.some(({ curves }) => curves.evaluations.generation.length);
  let over = "generation";
  let of = evaluated ? "evaluations" : "candidates";
  const draw = () => {
    charts.both(page.chart, runs, over, of);
    page.chart.setAttribute("aria-label", `${of} of ${one} and ${other} over ${over}`);
    say(page.caption, note(runs, of));
  };
  radios(page.over, "over", [["generation", "generations"], ["steps", "environment steps"], ["core_hours", "core-hours"]], over, (value) => {
    over = value;
    draw();
  });
  radios(page.of, "of", [["evaluations", "evaluated means"], ["candidates", "candidates' means"]], of, (value) => {
    of = value;
    draw();
  });
  draw();
  sides(page, runs);
});

// Two scores are of one kind only where the same world gives them, and two fitnesses where it is cut alike too.
const note = (runs, of) => {
  const kinds = new Set(runs.map(({ world, curves }) => (of === "candidates" ? `${world}: ${curves.fitness_axis}` : world)));
  return kinds.size > 1 ? "Take care: these two are not scored alike, so their heights say nothing of which is better." : "";
};

const radios = (parent, name, options, chosenOne, take) => {
  for (const [value, text] of options) {
    const label = make("label");
    const box = make("input", "", { type: "radio", name, value });
    box.checked = value === chosenOne;
    box.addEventListener("change", () => take(value));
    label.append(box, ` ${text}`);
    parent.append(label);
  }
};

const sides = (page, runs) => {
  for (const head of [page.names, page["names-too"]])
    head.replaceChildren(make("th", "", { scope: "col" }), ...runs.map((each) => {
      const cell = make("th", "", { scope: "col" });
      cell.append(make("a", each.run, { href: runLink(each.run) }));
      return cell;
    }));
  const tables = runs.map((each) => new Map(each.facts));
  page.sides.replaceChildren(...[...tables[0].keys()].map((name) => sideRow(name, tables)));
  const settings = runs.map((each) => new Map(each.settings));
  const differ = [...new Set(settings.flatMap((each) => [...each.keys()]))].filter((name) => settings[0].get(name) !== settings[1].get(name));
  page.differ.replaceChildren(...differ.map((name) => sideRow(name, settings)));
  page.same.hidden = differ.length > 0;
};

const sideRow = (name, tables) => {
  const row = make("tr");
  row.append(make("th", name, { scope: "row" }), ...tables.map((each) => make("td", each.get(name) ?? "-")));
  return row;
};
