// The hosts of a run over its time, from its journal: speed, slots at work, who came and who went.

import * as charts from "./charts.js";
import { ask, clock, fill, guarded, make, number, open, runLink, say, short } from "./dom.js";

const INKS = ["blue", "orange", "green", "purple", "red", "amber"]; // of the largest hosts; the others are one area
const REST = "muted";

export const show = guarded(async (current, wanted) => {
  document.title = "dreamfleet: hosts";
  const { runs } = await ask("runs");
  if (!current()) return;
  const names = runs.filter((each) => !each.damaged).sort((a, b) => (a.created < b.created ? 1 : -1));
  const name = wanted ?? (names.find((each) => each.state === "live") ?? names[0])?.run;
  const page = open("hosts");
  page.run.replaceChildren(...(name && !names.some((each) => each.run === name) ? [make("option", name)] : []), ...names.map((each) => make("option", each.run)));
  page.run.value = name ?? "";
  page.run.addEventListener("change", () => {
    location.hash = `#/hosts/${encodeURIComponent(page.run.value)}`;
  });
  page.body.hidden = true;
  if (!name) return say(page.sentence, "No run lies here yet, so there is nothing to show.");
  document.title = `${name}: hosts`;
  say(page.sentence, "Reading the journal…");
  let found;
  try {
    found = await ask(`hosts/${encodeURIComponent(name)}`);
  } catch (error) {
    if (current()) say(page.sentence, `${error.message}. A run's hosts are in its journal; without it the live page shows the last five minutes.`);
    return;
  }
  if (!current()) return;
  page.link.href = found.state === "live" ? `#/live/${encodeURIComponent(name)}` : runLink(name);
  say(page.link, found.state === "live" ? "The live run" : "Its result");
  page.link.hidden = false;
  if (!found.hosts.length) return say(page.sentence, "No worker has come yet.");
  page.body.hidden = false;
  fillPage(page, found);
});

const fillPage = (page, found) => {
  const { hosts, since, width } = found;
  const lives = hosts.reduce((sum, each) => sum + each.lives, 0);
  const count = (many, noun) => `${number(many, 0)} ${noun}${many === 1 ? "" : "s"}`;
  say(page.sentence, `${count(hosts.length + found.more, "host")}, ${count(lives, "worker")}; ${found.classes}.${found.checks && ` Checks: ${found.checks}.`}`);
  const series = (key) => {
    const shown = hosts.slice(0, INKS.length).map((each, index) => ({ name: each.host, ink: INKS[index], values: each[key] }));
    const rest = hosts.slice(INKS.length);
    if (rest.length) shown.push({ name: count(rest.length, "other host"), ink: REST, values: rest[0][key].map((_, at) => rest.reduce((sum, each) => sum + each[key][at], 0)) });
    return shown;
  };
  charts.stacked(page.rate, since, width, series("rate"), "steps/s by host");
  const there = found.events.length > 0;
  charts.placeholder(page.workers, there ? "" : "This journal names no arrivals: an older version wrote it.");
  if (there) charts.stacked(page.workers, since, width, series("workers"), "workers present, by host", { whole: true });
  page.rate.setAttribute("aria-label", `Steps a second of ${count(hosts.length, "host")}; the table below has the sums`);
  page.workers.setAttribute("aria-label", `Workers present of ${count(hosts.length, "host")}; the table below has their stays`);
  say(page.method, `Each point is ${short(width)} s. The journal keeps no moment of a result, so it counts evenly over the time that its generation took. It keeps no number of slots: "slots at work" is the slot time of accepted results in the time that the host was there.`);
  fillTable(page, found);
  page.came.hidden = !there;
  fill(page.events, found.events, () => {
    const each = make("li");
    each.append(make("time"), make("span"));
    return each;
  }, (each, { at, text }) => {
    say(each.firstChild, clock(at, width * hosts[0].rate.length));
    say(each.lastChild, text);
  });
};

const fillTable = (page, { hosts, since, width, more }) => {
  const whole = hosts.reduce((sum, each) => sum + each.steps, 0) || 1;
  const span = width * hosts[0].rate.length;
  page.hosts.replaceChildren(...hosts.map((each, index) => {
    const row = make("tr");
    const name = make("td", "", { class: "name" });
    const key = make("i", "", { class: "key area" });
    key.style.color = `var(--${INKS[index] ?? REST})`;
    name.append(key, make("b", each.host));
    row.append(name, stays(each.present, since, span));
    const cells = [["workers", number(each.lives, 0)], ["results", number(each.results, 0)], ["steps", number(each.steps, 0)],
      ["share", `${number((100 * each.steps) / whole, 1)} %`], ["slot time", `${number(each.seconds / 60)} min`], ["slots at work", each.there > 0 ? number(each.seconds / each.there, 2) : "-"]];
    for (const [label, text] of cells) row.append(make("td", text, { class: "n", "data-label": label }));
    return row;
  }));
  page.more.hidden = !more;
  say(page.more, `${number(more, 0)} more hosts are not listed.`);
};

// A bar from when each worker came until it went.
const stays = (present, since, span) => {
  const cell = make("td", "", { class: "stays" });
  const bar = make("div", "", { class: "stay" });
  for (const [came, went] of present) {
    const each = make("i");
    each.style.left = `${(100 * (came - since)) / span}%`;
    each.style.width = `max(3px, ${(100 * (went - came)) / span}%)`;
    each.title = `${clock(came, span)} to ${clock(went, span)}`;
    bar.append(each);
  }
  cell.append(bar);
  return cell;
};
