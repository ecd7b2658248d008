// The live view: the newest picture of whoever is watched, with its facts, while somebody sees it.

import { facts, make, say } from "./dom.js";

const MEASURED = 3000; // milliseconds over which a speed is measured
const NONE = "Workers score this task without drawing it; `dreamfleet record` and `live` draw it."; // in place of a picture; the figures follow
const KINDS = { score: "a candidate", evaluate: "the mean, in reality", collect: "the mean, to be kept" };

let page = null; // the parts, once they stand
let offered = false; // whether the dashboard has views at all
let run = ""; // that is live
let word = "seed"; // what its world calls one
let lost = false; // whether its coordinator was, when last heard of
let whom = ""; // as the address of a view asks for it
let paused = matchMedia("(prefers-reduced-motion: reduce)").matches;
let inSight = null; // an observer, and below what it saw
let seen = false;
let source = null;
let over = false; // its process ended: the button starts another
let listed = ""; // what there is to choose among
let evaluated = []; // generations
let rates = new Map(); // steps a second, by worker
let steps = []; // [milliseconds, step] of the episode that is driven for the page

export const offer = (views) => {
  offered = views;
};

export const show = (parts) => {
  page = parts;
  [whom, listed, evaluated] = ["", "", []];
  page["view-whom"].addEventListener("change", () => {
    whom = page["view-whom"].value;
    restart();
  });
  page["view-pause"].addEventListener("click", () => {
    paused = !paused;
    settle();
  });
  page["view-again"].addEventListener("click", restart);
  inSight = new IntersectionObserver((changes) => {
    seen = changes.at(-1).isIntersecting; // a busy page hears of several at once
    settle();
  });
  inSight.observe(page.view);
};

export const leave = () => {
  close();
  inSight?.disconnect();
  [page, run, seen, over] = [null, "", false, false];
};

// What can be watched of the run that the page shows; nothing where it is not live.
export const fill = (frame) => {
  const there = offered && (frame.link === "live" || (frame.link === "lost" && run === frame.run));
  page.view.hidden = !there;
  page.body.classList.toggle("viewed", there);
  if (!there) run = "";
  else if (run !== frame.run || (over && lost && frame.link === "live")) {
    run = frame.run;
    restart();
  }
  lost = frame.link === "lost";
  rates = new Map(frame.workers?.worker.map((name, index) => [name, frame.workers.rate[index]]));
  word = frame.word ?? word;
  if (there) choices(frame);
  settle();
};

export const drawCurves = (curves) => {
  evaluated = curves.evaluations.generation;
};

const choices = ({ workers, stored }) => {
  const names = workers.worker.filter((_, index) => workers.state[index] === "present");
  const means = stored ? evaluated : [];
  const key = `${names.join()}|${means.join()}`;
  if (key === listed) return;
  listed = key;
  const all = [
    make("option", "the busiest worker", { value: "" }),
    make("option", "the best mean, driven here", { value: "best=" }),
    ...group("Workers", names.map((name) => [name, `worker=${encodeURIComponent(name)}`])),
    ...group("Evaluated means, driven here", means.map((each) => [`generation ${each}`, `generation=${each}`]).reverse()),
  ];
  const select = page["view-whom"];
  select.replaceChildren(...all);
  if (![...select.options].some((each) => each.value === whom))
    select.append(make("option", `${decodeURIComponent(whom.split("=")[1])}, gone`, { value: whom }));
  select.value = whom;
};

const group = (label, rows) => {
  if (!rows.length) return [];
  const whole = make("optgroup", "", { label });
  whole.append(...rows.map(([name, value]) => make("option", name, { value })));
  return [whole];
};

const restart = () => {
  close();
  over = false;
  steps = [];
  page["view-picture"].hidden = true;
  facts(page["view-facts"], []);
  showText("");
  settle();
};

const close = () => {
  source?.close();
  source = null;
};

// Open where somebody looks, shut where nobody does.
export const settle = () => {
  if (!page) return;
  say(page["view-pause"], paused ? "Play" : "Pause");
  const wanted = run && seen && !paused && !over && !document.hidden;
  if (!wanted && source && !paused && page["view-picture"].hidden) facts(page["view-facts"], []); // else they would pass for news
  if (!wanted) close();
  if (paused && !over) showText(page["view-picture"].hidden ? "Paused: nothing is drawn or sent." : "");
  if (!wanted || source) return;
  source = new EventSource(`view?run=${encodeURIComponent(run)}${whom && `&${whom}`}`);
  source.addEventListener("picture", (event) => draw(JSON.parse(event.data)));
  source.addEventListener("state", (event) => {
    const { state, text } = JSON.parse(event.data);
    if (state === "ended") end(text);
    else showText(text);
  });
  source.onerror = () => end("The dashboard gives no live view: it was ended, or too many look at once.");
};

const end = (text) => {
  close();
  over = true;
  showText(text);
};

const showText = (text) => {
  const picture = page["view-picture"];
  picture.classList.toggle("stale", over);
  picture.parentElement.classList.toggle("bare", picture.hidden && (over || paused || text === NONE));
  page["view-again"].hidden = !over;
  say(page["view-text"], text);
};

const draw = ({ facts: named, jpeg }) => {
  const picture = page["view-picture"];
  facts(page["view-facts"], rows(named));
  if (named.drawn === false) {
    picture.hidden = true;
    return showText(NONE);
  }
  picture.src = `data:image/jpeg;base64,${jpeg}`;
  const alt = `${page["view-whom"].selectedOptions[0].textContent}: ${(named.captions ?? []).join(", ")}; the figures follow`;
  if (picture.alt !== alt) picture.alt = alt;
  if (picture.hidden) {
    picture.hidden = false;
    showText("");
  }
};

const rows = ({ worker, kind, generation, candidate, seed, step, score, captions = [] }) => {
  const found = [["shown", captions.join(", ") || null], ["worker", worker], ["drive of", worker ? (KINDS[kind] ?? kind) : "a mean, here"],
    ["generation", generation], ["candidate", kind === "score" ? candidate : null], [kind === "score" ? "seed" : word, seed], ["step", step],
    ["score so far", score?.toFixed(1).replace(/^-0\.0$/, "0.0")], ["speed", speed(worker, step)]];
  return found.filter(([, value]) => value !== null && value !== undefined).map(([name, value]) => [name, String(value)]);
};

// A worker's is the fleet's figure; what is driven for the page is timed here.
const speed = (worker, step) => {
  if (worker) return rates.has(worker) ? `${rates.get(worker).toLocaleString("en")} steps/s` : null;
  const now = performance.now();
  if (!steps.length || step < steps.at(-1)[1]) steps = [];
  steps.push([now, step]);
  while (now - steps[0][0] > MEASURED) steps.shift();
  const passed = now - steps[0][0];
  return passed > 500 ? `${Math.round((1000 * (step - steps[0][1])) / passed)} steps/s` : null;
};
