// Two runs side by side: their scores on one chart, the paired differences of them, and what differs in their settings.

import * as charts from "./charts.js";
import { ask, guarded, make, open, runLink, say } from "./dom.js";

export const show = guarded(async (current, one, other) => {
  document.title = `${one} and ${other}`;
  const address = (name) => encodeURIComponent(name);
  const [runs, compared, listed] = await Promise.all([
    Promise.all([one, other].map((name) => ask(`runs/${address(name)}`))),
    ask(`compare/${address(one)}/${address(other)}`),
    ask("runs"),
  ]);
  if (!current()) return;
  const page = open("compare");
  const names = listed.runs.filter((each) => !each.damaged).map((each) => each.run);
  [page.a, page.b].forEach((select, index) => {
    select.replaceChildren(...names.map((name) => make("option", name)));
    select.value = runs[index].run;
    select.addEventListener("change", () => {
      location.hash = `#/compare/${address(page.a.value)}/${address(page.b.value)}`;
    });
  });
  fillDifferences(page, runs, compared);
  fillChart(page, runs);
  fillSides(page, runs, compared);
});

const fillDifferences = (page, runs, { worlds, differences, problem }) => {
  const [first, second] = runs.map((each) => each.run);
  const known = differences.filter((each) => each.mean !== undefined);
  const why = problem ? `The two cannot be paired: ${problem}.` : worlds.length > 1
    ? `The evaluations are of the worlds ${worlds.join(" and ")}, so no difference is taken.`
    : "A difference is taken once both runs have evaluated means.";
  page["paired-note"].hidden = page["paired-table"].hidden = !differences.length;
  page["paired-why"].hidden = differences.length > 0;
  say(page["paired-why"], why);
  page.paired.replaceChildren(...differences.map(({ of, size, on, verdict, clear }) => {
    const row = make("tr");
    row.append(make("th", of, { scope: "row" }), make("td", size ?? "-", { class: "n" }), make("td", on ?? ""), make("td", verdict, { class: clear ? "clear" : "" }));
    return row;
  }));
  say(page["paired-size"], `${second} − ${first}`);
  page["paired-figure"].hidden = !known.length;
  if (!known.length) return;
  charts.differences(page["paired-chart"], known, `score, ${second} − ${first}`);
  page["paired-chart"].setAttribute("aria-label", known.map((each) => `${each.of}: ${each.size}, ${each.verdict}`).join("; "));
};

const fillChart = (page, runs) => {
  let over = "generation";
  let of = runs.some(({ curves }) => curves.evaluations.generation.length) ? "evaluations" : "candidates";
  const draw = () => {
    charts.both(page.chart, runs, over, of);
    page.chart.setAttribute("aria-label", `${of} of ${runs.map((each) => each.run).join(" and ")} over ${over}`);
    say(page.caption, note(runs, of) || (of === "evaluations" ? "Bars: ± one standard error." : ""));
  };
  radios(page.over, "over", [["generation", "generations"], ["steps", runs.every(({ curves }) => curves.score_word === "value") ? "calls" : "environment steps"], ["core_hours", "core-hours"]], over, (value) => {
    over = value;
    draw();
  });
  radios(page.of, "of", [["evaluations", "evaluated means"], ["candidates", "candidates' means"]], of, (value) => {
    of = value;
    draw();
  });
  draw();
};

// Two scores are of one kind only where the same world gives them, and two fitnesses where it is cut alike too.
const note = (runs, of) => {
  const kinds = new Set(runs.map(({ world, curves }) => (of === "candidates" ? `${world}: ${curves.fitness_axis}` : world)));
  return kinds.size > 1 ? "Take care: these two are not scored alike, so their heights say nothing of which is better." : "";
};

const radios = (parent, name, options, chosen, take) => {
  for (const [value, text] of options) {
    const label = make("label");
    const box = make("input", "", { type: "radio", name, value });
    box.checked = value === chosen;
    box.addEventListener("change", () => take(value));
    label.append(box, ` ${text}`);
    parent.append(label);
  }
};

const fillSides = (page, runs, { settings }) => {
  for (const head of [page.names, page["names-too"]])
    head.replaceChildren(make("th", "", { scope: "col" }), ...runs.map((each, index) => {
      const cell = make("th", "", { scope: "col" });
      cell.append(make("i", "", { class: `key ${["first", "second"][index]}` }), make("a", each.run, { href: runLink(each.run) }));
      return cell;
    }));
  const tables = runs.map((each) => new Map([...each.facts, ...each.outcome]));
  const rows = [...new Set(tables.flatMap((each) => [...each.keys()]))];
  page.sides.replaceChildren(...rows.map((name) => sideRow(name, tables.map((each) => each.get(name) ?? "-"))));
  page.differ.replaceChildren(...settings.map(([name, ...values]) => sideRow(name, values)));
  page["differ-table"].hidden = !settings.length;
  page.same.hidden = settings.length > 0;
};

const sideRow = (name, values) => {
  const row = make("tr");
  row.append(make("th", name, { scope: "row" }), ...values.map((each) => make("td", each)));
  return row;
};
