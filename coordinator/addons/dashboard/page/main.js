// Which page is shown, the stream of the runs' states, and the theme.

import * as charts from "./charts.js";
import * as compare from "./compare.js";
import { leave, say } from "./dom.js";
import * as hosts from "./hosts.js";
import * as live from "./live.js";
import * as runs from "./runs.js";
import * as view from "./view.js";

const SILENCE = 4000; // four of feed.py's REFRESH, in milliseconds without a word after which the dashboard itself is missed
const silent = document.getElementById("silent");
const digest = new URL(import.meta.url).pathname.split("/").at(-2);

let source = null;
let wanted = ""; // the live run that was asked for by name; empty: whichever there is
let heard = performance.now(); // not by the wall clock, which may be set
let latest = null; // what is not painted yet: of several frames the last one alone is
let painting = false;

const paint = () => {
  painting = false;
  if (!latest) return;
  const { frame, curves } = latest;
  latest = null;
  performance.mark("update-begins");
  if (frame) live.fillFrame(frame, wanted);
  if (curves) live.drawCurves(curves);
  // The next task after a frame's begins once that is painted.
  requestAnimationFrame(() => {
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = () => performance.measure("update", "update-begins");
    port2.postMessage(null);
  });
};

const take = (part) => {
  heard = performance.now();
  silent.hidden = true;
  latest = { ...latest, ...part };
  if (!painting) {
    painting = true;
    requestAnimationFrame(paint);
  }
};

const listen = () => {
  source?.close();
  latest = null;
  heard = performance.now();
  source = new EventSource(wanted ? `live?run=${encodeURIComponent(wanted)}` : "live");
  source.addEventListener("hello", (event) => {
    const hello = JSON.parse(event.data);
    if (hello.digest !== digest) location.reload(); // another version of the page is served now
    view.offer(hello.views);
  });
  source.addEventListener("frame", (event) => take({ frame: JSON.parse(event.data) }));
  source.addEventListener("curves", (event) => take({ curves: JSON.parse(event.data) }));
  source.onerror = () => {
    // A browser gives up where the answer is an error, such as that of a proxy while the dashboard is away.
    if (source?.readyState === EventSource.CLOSED) setTimeout(() => source?.readyState === EventSource.CLOSED && listen(), 1000);
  };
};

const hush = () => {
  source?.close();
  source = null;
  silent.hidden = true;
};

setInterval(() => {
  const silence = performance.now() - heard;
  if (!source || silence < SILENCE) return;
  silent.hidden = false;
  say(silent, `No word from the dashboard since ${new Date(Date.now() - silence).toLocaleTimeString("en-GB")}: it was ended, or the network is cut. The runs go on without it.`);
}, 500);

// Nobody is asked anything for a page that nobody sees.
document.addEventListener("visibilitychange", () => {
  if (currentPage() !== "live") return;
  view.settle();
  if (document.hidden) hush();
  else listen();
});

const words = () => {
  try {
    return location.hash.replace(/^#\/?/, "").split("/").map(decodeURIComponent);
  } catch {
    return []; // half an escape
  }
};
const currentPage = () => words()[0] || "live";

const route = () => {
  const [, ...names] = words();
  const page = currentPage();
  hush();
  charts.forget();
  live.leave();
  leave();
  for (const link of document.querySelectorAll(".bar nav a")) {
    const here = link.dataset.page === (page === "live" || page === "hosts" ? page : "runs");
    if (here) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  window.scrollTo(0, 0);
  if (page === "runs") runs.showRuns();
  else if (page === "run" && names[0]) runs.showRun(names[0]);
  else if (page === "compare" && names[1]) compare.show(names[0], names[1]);
  else if (page === "hosts") hosts.show(names[0]);
  else {
    wanted = page === "live" ? (names[0] ?? "") : "";
    live.show();
    if (!document.hidden) listen();
  }
};

const THEMES = ["system", "light", "dark"];
const button = document.getElementById("theme");
const theme = () => document.documentElement.dataset.theme ?? "system";
const recolour = () => {
  say(button.lastElementChild, theme());
  charts.redraw();
  live.redraw();
};
button.addEventListener("click", () => {
  const next = THEMES[(THEMES.indexOf(theme()) + 1) % THEMES.length];
  if (next === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = next;
  try {
    localStorage.setItem("theme", next);
  } catch {
    // it holds for this page then
  }
  recolour();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
say(button.lastElementChild, theme());

document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // the address says which page is shown
  document.getElementById("main").focus();
});
window.addEventListener("hashchange", route);
route();
